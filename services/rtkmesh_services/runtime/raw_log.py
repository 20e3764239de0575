"""One log on disk: whole frames or texts as they came, perhaps ``.times`` and RTKLIB's ``.tag`` beside it; only ever appended to.

Frames wait in memory until ``write_out`` takes them to the disk, the data first, then the times that belong to them. What a full disk
refuses stays in memory, to the byte: the file goes on where it stopped when there is room. Beyond ``MAXIMUM_PENDING`` new frames are
refused, so that a log has gaps between frames, never within one.
"""

import os
import struct
from collections import deque
from contextlib import suppress
from datetime import datetime
from itertools import accumulate
from pathlib import Path
from typing import Final

from rtkmesh_services.runtime.time_tags import TagWriter

MAXIMUM_PENDING: Final = 4 << 20
_BATCH: Final = 1 << 20  # bytes that are written at once
ATTACHMENT: Final = struct.Struct("<QqQ")  # sequence, UTC ns, monotonic ns
_OPEN: Final = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | os.O_CLOEXEC

Waiting = tuple[bytes, bytes | None]  # a frame and its attachment
Row = tuple[bytes, ...]  # of a frame: its data, then its line of .times and its record of .tag where there are such files


class RawLog:
    """One open log with its times. ``append`` is called by the work loop, what writes by the writer's thread alone.

    FileExistsError where one of its files is there already.
    """

    def __init__(self, path: Path, number: int, *, tags: bool, times: bool = True) -> None:
        self.path, self.number = path, number
        self.size = self.frames = 0  # of what was appended
        self._given_back = self._written = 0  # bytes, counted by the writer
        self._has_times, self._has_tags = times, tags
        endings = ("", *[".times"] * times, *[".tag"] * tags)
        paths = [path.with_name(path.name + ending) for ending in endings]
        if taken := next((one for one in paths if one.exists()), None):
            raise FileExistsError(f"{taken} is there already")
        self._files = [_File(one) for one in paths]
        self._tags: TagWriter | None = None
        self._waiting: deque[Waiting] = deque()
        self._batch: list[Waiting] = []  # that is being written: its data first, then all its times
        self._rows: list[Row] = []
        self._dirty = True  # its name is not on the disk yet

    @staticmethod
    def create(folder: Path, name: str, protocol: str, started: datetime, number: int = 0, *, tags: bool = False) -> "RawLog":
        """Open a log of a receiver's frames under a name that does not exist yet."""
        return RawLog.beside(folder / f"{name}-{started:%Y%m%dT%H%M%SZ}.{protocol}", number, tags=tags)

    @staticmethod
    def beside(path: Path, number: int = 0, *, tags: bool = False, times: bool = True) -> "RawLog":
        """Open a log at a path, or as NAME-1, NAME-2 ... where there is one already."""
        path.parent.mkdir(parents=True, exist_ok=True)
        for count in range(1000):
            with suppress(FileExistsError):
                return RawLog(path.with_name(f"{path.stem}-{count}{path.suffix}") if count else path, number, tags=tags, times=times)
        raise OSError(f"{path.parent}: no free name for {path.name}")

    def append(self, payload: bytes, attachment: bytes | None) -> bool:
        """Take one frame; False when too much waits already."""
        if self.pending + len(payload) > MAXIMUM_PENDING:
            return False
        self.size += len(payload)
        self.frames += 1
        self._waiting.append((payload, attachment))
        return True

    @property
    def pending(self) -> int:
        """Bytes that wait to be written."""
        return self.size + self._given_back - self._written

    def give_back(self, frames: list[Waiting]) -> None:
        """Put frames before all others: what a log that may not grow any more did not take."""
        self._waiting.extendleft(reversed(frames))
        self._given_back += sum(len(payload) for payload, _ in frames)

    def write_out(self) -> None:
        """Write what waits; OSError when the disk takes no more, and then the rest waits on."""
        while True:
            for file in self._files:
                self._dirty |= bool(file.rest)
                file.write()
            self._batch = self._next_batch()
            if not self._batch:
                return

    def sync(self) -> None:
        """Let the disk take what was written; may take long."""
        if self._dirty:
            self._dirty = False
            for file in self._files:
                os.fsync(file.descriptor)
            _sync_folder(self.path.parent)

    def finish(self) -> list[Waiting]:
        """Write what can be written, cut a part of a frame; return the frames that are not in the file."""
        with suppress(OSError):
            self.write_out()
        left = [*self._end_batch(), *self._waiting]
        self._waiting.clear()
        return left

    def close(self) -> None:
        """Let the disk take all of it, and let go of the files."""
        with suppress(OSError):
            self.sync()
        files, self._files = self._files, []  # a number that is closed twice may be somebody else's by then
        for file in files:
            os.close(file.descriptor)

    def _next_batch(self) -> list[Waiting]:
        batch: list[Waiting] = []
        before, self._rows = self._written, []
        while self._waiting and self._written - before < _BATCH:
            batch.append(self._waiting.popleft())
            self._written += len(batch[-1][0])
            self._rows.append(self._row(*batch[-1]))
        for column, file in enumerate(self._files):
            file.rest = b"".join([row[column] for row in self._rows])
        return batch

    def _end_batch(self) -> list[Waiting]:
        """Cut the frame of which a full disk took a part only; return the frames of the batch that are not in the file."""
        data, ends = self._files[0], list(accumulate(len(payload) for payload, _ in self._batch))
        if not data.rest:
            return []
        taken = ends[-1] - len(data.rest)
        whole = sum(end <= taken for end in ends)
        with suppress(OSError):
            os.ftruncate(data.descriptor, os.fstat(data.descriptor).st_size - (taken - (ends[whole - 1] if whole else 0)))
        for column, file in enumerate(self._files[1:], 1):
            file.rest = b"".join([row[column] for row in self._rows[:whole]])
            with suppress(OSError):
                file.write()
            file.rest = b""
        data.rest, left = b"", self._batch[whole:]
        return left

    def _row(self, payload: bytes, attachment: bytes | None) -> Row:
        if attachment is None or len(attachment) != ATTACHMENT.size:
            return (payload,) + (b"",) * (len(self._files) - 1)
        sequence, utc_ns, mono_ns = ATTACHMENT.unpack(attachment)
        times = (b"%d %d %d %d\n" % (sequence, utc_ns, mono_ns, len(payload)),) if self._has_times else ()
        return (payload, *times, self._tag(utc_ns, mono_ns)) if self._has_tags else (payload, *times)

    def _tag(self, utc_ns: int, mono_ns: int) -> bytes:
        header = b""
        if self._tags is None:
            self._tags = TagWriter(utc_ns, mono_ns)
            header = self._tags.header
        return header + self._tags.record(mono_ns, self._written)


class _File:
    """A new file that is only appended to; ``rest`` is what it has not taken yet."""

    def __init__(self, path: Path) -> None:
        self.descriptor = os.open(path, _OPEN, 0o644)
        self.rest = b""

    def write(self) -> None:
        while self.rest:
            self.rest = self.rest[os.write(self.descriptor, self.rest) :]


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
