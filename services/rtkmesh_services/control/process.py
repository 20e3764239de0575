"""One child process on Linux: its own session, no orphan, output read line by line without ever blocking."""

import contextlib
import os
import signal
import subprocess
from collections.abc import Callable, Sequence
from typing import IO, Final, Protocol

from rtkmesh_services.control.fleet import ProcessSpec
from rtkmesh_services.control.output import OutputLine, ProcessLog, parse_line
from rtkmesh_services.runtime.host_processes import identity_of
from rtkmesh_services.runtime.log_files import open_log

PARENT_VARIABLE: Final = "RTKMESH_PARENT"  # the child asks the kernel to kill it when this process is gone
_LINE_BYTES: Final = 4096
_READ_BYTES: Final = 65536


class Started(Protocol):
    """A process of ours that has been started, however; ``subprocess.Popen`` is one."""

    @property
    def pid(self) -> int:
        """Its number, also that of its group."""
        ...

    @property
    def stdout(self) -> IO[bytes] | None:
        """Our end of its output."""
        ...

    @property
    def stderr(self) -> IO[bytes] | None:
        """Our end of its error output."""
        ...

    def wait(self) -> int:
        """Wait for its end; return its exit code, negative for a signal."""
        ...


Start = Callable[[ProcessSpec], Started]


def start_program(spec: ProcessSpec, inherited: Sequence[int] = ()) -> Started:
    """Start a process as a program that also gets some of our descriptors; OSError if that fails."""
    log = None if spec.log_file is None else open_log(spec.log_file)
    try:
        return subprocess.Popen(
            spec.argv,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE if log is None else log,
            stderr=subprocess.PIPE if log is None else log,
            env=environment_of(spec),
            pass_fds=inherited,
            start_new_session=True,
            bufsize=0,
        )
    finally:
        if log is not None:
            os.close(log)


def environment_of(spec: ProcessSpec) -> dict[str, str]:
    """Return the environment of a process: one that does not outlive control is told whose death is its own."""
    return dict(spec.environment) | ({PARENT_VARIABLE: str(os.getpid())} if spec.log_file is None else {})


class Child:
    """A running process. Made in the thread that lives as long as the child may: its death is the child's (PR_SET_PDEATHSIG)."""

    def __init__(self, spec: ProcessSpec, on_line: Callable[[OutputLine], None], start: Start = start_program) -> None:
        """Start the process; OSError if that fails."""
        self.spec, self.definition = spec, spec.definition
        self._on_line = on_line
        self._log = ProcessLog(spec)
        self._log.begins()
        self._process = start(spec)
        self.pid = self._process.pid
        self.identity = identity_of(self.pid)
        self.exit_descriptor = _pidfd(self.pid)
        self._last_error = ""
        self._streams = {pipe.fileno(): _Lines(pipe, error_stream=pipe is self._process.stderr) for pipe in self._pipes()}

    def descriptors(self) -> list[int]:
        """Return the descriptors to wait on: the output, and the exit where the kernel offers it."""
        ends = [] if self.exit_descriptor is None else [self.exit_descriptor]
        return [*self._streams, *ends]

    def read(self, descriptor: int) -> bool:
        """Read what is there; False when this stream is at its end."""
        stream = self._streams.get(descriptor)
        if stream is None:
            return False
        open_ = stream.read(self._line)
        if not open_:
            del self._streams[descriptor]
            stream.close()
        return open_

    def signal(self, number: int) -> None:
        """Send a signal to the whole process group."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.pid, number)

    def reap(self) -> int | None:
        """Return the exit code if the process has ended, and end what it left in its group; else None."""
        if os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
            return None
        self.signal(signal.SIGKILL)  # the zombie still holds the group's number
        for descriptor in list(self._streams):
            while self.read(descriptor) and self._streams[descriptor].more:
                pass
        code = self._process.wait()
        self._close()
        reap_group(self.pid)
        return code

    @property
    def last_error(self) -> str:
        """The newest line that says what went wrong."""
        return self._last_error or self._log.last_error()

    def _line(self, raw: bytes, error_stream: bool) -> None:
        line = parse_line(self.spec.id, raw, error_stream=error_stream)
        if line.text and (line.level in ("error", "critical") or (error_stream and not line.structured)):
            self._last_error = line.text[:300]
        if line.text:
            self._on_line(line)

    def _pipes(self) -> list[IO[bytes]]:
        pipes = [pipe for pipe in (self._process.stdout, self._process.stderr) if pipe is not None]
        for pipe in pipes:
            os.set_blocking(pipe.fileno(), False)
        return pipes

    def _close(self) -> None:
        for stream in self._streams.values():
            stream.close()
        self._streams.clear()
        if self.exit_descriptor is not None:
            os.close(self.exit_descriptor)
            self.exit_descriptor = None


class _Lines:
    """Bytes of a pipe to lines of bounded length."""

    def __init__(self, pipe: IO[bytes], *, error_stream: bool) -> None:
        self._pipe, self._error_stream, self._rest, self.more = pipe, error_stream, b"", True

    def read(self, on_line: Callable[[bytes, bool], None]) -> bool:
        """Read once; False at the end. ``more`` says whether there may be more at once."""
        try:
            data = os.read(self._pipe.fileno(), _READ_BYTES)
        except BlockingIOError:
            self.more = False
            return True
        *lines, self._rest = (self._rest + data).split(b"\n")
        if not data or len(self._rest) > _LINE_BYTES:
            lines, self._rest = [*lines, self._rest], b""
        for line in lines:
            on_line(line[:_LINE_BYTES], self._error_stream)
        self.more = bool(data)
        return bool(data)

    def close(self) -> None:
        self._pipe.close()


def reap_group(pid: int) -> None:
    """Take leave of what was left in an ended process's group and has become ours."""
    with contextlib.suppress(ChildProcessError):
        while os.waitpid(-pid, os.WNOHANG) != (0, 0):
            pass


def _pidfd(pid: int) -> int | None:
    try:
        return os.pidfd_open(pid)
    except OSError:  # an old kernel or a sandbox: the keeper polls instead
        return None
