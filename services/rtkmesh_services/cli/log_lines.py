"""Lines of several log files in the order of their times, and those that come after them."""

import os
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

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
    _inode: int = 0
    _offset: int = 0
    _rest: bytes = b""
    _time: str = ""

    def begin(self) -> list[OutputLine]:
        """Return all lines that are kept; ``read`` then gives those that come after them."""
        with suppress(OSError):
            self._inode = older(self.file).stat().st_ino
        return self.read()

    def read(self) -> list[OutputLine]:
        """Return the whole lines that have come."""
        data = self._added()
        *rows, self._rest = (self._rest + data).split(b"\n")
        lines = list(timed(self.id, rows, self._time))
        self._time = lines[-1].time if lines else self._time
        return lines

    def _added(self) -> bytes:
        """Return what was added: where we were, also if that file is the older one now, and then what is in the new one."""
        try:
            with self.file.open("rb") as stream:
                inode, before = os.fstat(stream.fileno()).st_ino, b""
                if inode != self._inode:
                    before, self._inode, self._offset = self._end_of_older(), inode, 0
                stream.seek(self._offset)
                data = stream.read()
                self._offset += len(data)
        except OSError:
            return b""
        return before + data

    def _end_of_older(self) -> bytes:
        with suppress(OSError), older(self.file).open("rb") as stream:
            if os.fstat(stream.fileno()).st_ino == self._inode:
                stream.seek(self._offset)
                return stream.read()
        return b""


def log_files(folder: Path) -> dict[str, Path]:
    """Return the log files of a folder by process."""
    with suppress(OSError):
        return {path.stem: path for path in sorted(folder.glob("*.log"))}
    return {}
