"""Lines of several log files in the order of their times, and those that come after them."""

import os
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final

from rtkmesh_services.control.output import OutputLine, parse_line
from rtkmesh_services.runtime.log_files import older

LEVELS: Final = ("debug", "info", "warning", "error", "critical")
_LINE_BYTES: Final = 65536


@dataclass(frozen=True, slots=True)
class Wanted:
    """Which lines are shown: those of a level and above. What is no log record (a trace, a library's word) counts as a warning."""

    level: str = "debug"

    def __call__(self, line: OutputLine) -> bool:
        """Whether a line is shown."""
        level = line.level if line.level in LEVELS else "warning"
        return bool(line.text) and LEVELS.index(level) >= LEVELS.index(self.level)


def newest(lines: list[OutputLine], count: int, wanted: Wanted) -> list[OutputLine]:
    """Return the newest of the lines that are wanted."""
    found = [line for line in lines if wanted(line)]
    return found[-count:] if count > 0 else []


def timed(id_: str, rows: list[bytes], time: str = "") -> Iterator[OutputLine]:
    """Yield the lines of one process; what has no time of its own has that of the line before."""
    for row in rows:
        line = parse_line(id_, row[:_LINE_BYTES], error_stream=True)
        time = line.time or time
        yield OutputLine(line.id, line.text, line.level, line.error_stream, line.structured, time)


@dataclass(slots=True)
class Follower:
    """Reads what is added to one log file, also when a new one takes its place."""

    id: str
    file: Path
    _stream: IO[bytes] | None = None
    _rest: bytes = b""
    _time: str = ""

    def begin(self) -> list[OutputLine]:
        """Return all lines that are kept; ``read`` then gives those that come after them."""
        self._open()
        before: list[bytes] = []
        with suppress(OSError):
            file = older(self.file)
            if self._stream is None or not os.path.samestat(file.stat(), os.fstat(self._stream.fileno())):
                before = file.read_bytes().splitlines()
        lines = list(timed(self.id, before))
        self._time = lines[-1].time if lines else ""
        return lines + self.read()

    def read(self) -> list[OutputLine]:
        """Return the whole lines that have come."""
        if self._stream is None:
            self._open()
        found = self._read()
        if self._is_replaced():
            found += self._read()  # what came until then
            self._close()
            self._open()
            found += self._read()
        return found

    def _read(self) -> list[OutputLine]:
        if self._stream is None:
            return []
        *rows, self._rest = (self._rest + self._stream.read()).split(b"\n")
        lines = list(timed(self.id, rows, self._time))
        self._time = lines[-1].time if lines else self._time
        return lines

    def _open(self) -> None:
        with suppress(OSError):
            self._stream = self.file.open("rb")

    def _close(self) -> None:
        if self._stream is not None:
            self._stream.close()
            self._stream = None

    def _is_replaced(self) -> bool:
        if self._stream is None:
            return False
        try:
            there = self.file.stat()
        except OSError:
            return False
        return not os.path.samestat(there, os.fstat(self._stream.fileno()))


def log_files(folder: Path) -> dict[str, Path]:
    """Return the log files of a folder by process."""
    with suppress(OSError):
        return {path.stem: path for path in sorted(folder.glob("*.log"))}
    return {}
