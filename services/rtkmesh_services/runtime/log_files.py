"""Output of processes in files of bounded size, which go on being written when whoever started the process has gone.

A process is started with its output in such a file and told its name: it then renames the file to ``NAME.1`` when it is full and writes on
in a new one, also with what libraries and the interpreter write. So nobody has to read, and nothing blocks or breaks.
"""

import contextlib
import logging
import os
import threading
from pathlib import Path
from typing import Final

VARIABLE: Final = "RTKMESH_LOG_FILE"
FULL_BYTES: Final = 1 << 20
CHECK_S: Final = 5.0  # for what is written without a log record
_OUTPUTS: Final = (1, 2)
_TAIL_BYTES: Final = 1 << 16


def bound_own_output(full_bytes: int = FULL_BYTES) -> None:
    """Keep the file of this process's output within bounds, if ``RTKMESH_LOG_FILE`` names one."""
    if name := os.environ.get(VARIABLE):
        bound = Bound(Path(name), full_bytes)
        for handler in logging.getLogger().handlers:
            handler.addFilter(bound)
        threading.Thread(target=bound.watch, name="log-file", daemon=True).start()


class Bound(logging.Filter):
    """Looks at the size of the file at every record and every few seconds. The old half is kept as ``NAME.1``."""

    def __init__(self, file: Path, full_bytes: int) -> None:
        super().__init__()
        self._file, self._full_bytes, self._lock = file, full_bytes, threading.Lock()

    def filter(self, record: logging.LogRecord) -> bool:  # noqa: ARG002  every record passes
        """See logging."""
        self.check()
        return True

    def watch(self) -> None:
        """Check again and again, in a thread of its own."""
        pause = threading.Event()
        while not pause.wait(CHECK_S):
            self.check()

    def check(self) -> None:
        """Begin a new file if this one is full. A folder that is full or gone changes nothing: writing goes on where it was."""
        with contextlib.suppress(OSError), self._lock:
            if os.fstat(_OUTPUTS[-1]).st_size >= self._full_bytes:
                if self._is_ours():
                    self._file.replace(older(self._file))
                redirect(open_log(self._file))

    def _is_ours(self) -> bool:
        """Whether the name still means our output: somebody may have taken the file away."""
        return self._file.exists() and os.path.samestat(os.fstat(_OUTPUTS[-1]), self._file.stat())


def open_log(file: Path) -> int:
    """Return a descriptor that appends to a log file, which only its owner reads; OSError if that fails."""
    file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    return os.open(file, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o600)


def redirect(descriptor: int) -> None:
    """Let output and error output of this process go to a descriptor, which is closed."""
    for target in _OUTPUTS:
        os.dup2(descriptor, target)
    os.close(descriptor)


def older(file: Path) -> Path:
    """Return the name of the file with what came before."""
    return file.with_name(file.name + ".1")


def append(file: Path, line: bytes) -> None:
    """Add one line; what cannot be written is left out."""
    with contextlib.suppress(OSError):
        descriptor = open_log(file)
        try:
            os.write(descriptor, line + b"\n")
        finally:
            os.close(descriptor)


def tail(file: Path, count: int, size: int = _TAIL_BYTES) -> list[bytes]:
    """Return the last lines of a log, oldest first, looking at most ``size`` bytes back. An unfinished line counts."""
    data = _last_bytes(file, size)
    if len(data) < size:
        data = _last_bytes(older(file), size - len(data)) + data
    lines = data.splitlines()
    return lines[-count:] if count > 0 else []


def _last_bytes(file: Path, size: int) -> bytes:
    try:
        with file.open("rb") as stream:
            end = stream.seek(0, os.SEEK_END)
            stream.seek(max(0, end - size))
            data = stream.read(size)
    except OSError:
        return b""
    return data if end <= size else data.partition(b"\n")[2]
