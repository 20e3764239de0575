"""Logs after a crash or a power cut: what is whole in them, with times that fit, in new files. The originals are only read.

A log that was cut ends in a part of a frame, or in zeros where the file system knew its length and not its content. Its ``.times`` may be
behind it or ahead of it. Whole is what the framer says; a frame without a line of ``.times`` gets the instant of the one before it.
"""

import os
from array import array
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path
from typing import Any, BinaryIO, Final

from rtkmesh.codecs.framing import FRAMED, Framer
from rtkmesh.codecs.messages import Frame
from rtkmesh_services.runtime.time_tags import TagWriter, parse_tag

RECOVERED: Final = ".recovered"
_PIECE: Final = 1 << 20
_PROTOCOLS: Final = {protocol.value: protocol for protocol in FRAMED}

Row = tuple[int, int, int, int]  # of a .times: sequence, UTC ns, monotonic ns, bytes


@dataclass(slots=True)
class Finding:
    """What one log is like. ``written``: the new files, empty where the log is whole (or
    with ``error``); ``before``: they were there already.
    """

    path: Path
    bytes: int = 0
    frames: int = 0
    cut_bytes: int = 0
    gap_bytes: int = 0
    faults: list[str] = field(default_factory=list[str])
    written: list[Path] = field(default_factory=list[Path])
    before: bool = False
    error: str = ""

    def row(self) -> dict[str, Any]:
        """Return it for JSON."""
        return {
            "path": str(self.path),
            "bytes": self.bytes,
            "frames": self.frames,
            "cut_bytes": self.cut_bytes,
            "gap_bytes": self.gap_bytes,
            "faults": self.faults,
            "before": self.before,
            "written": [str(path) for path in self.written],
            "error": self.error,
        }


def logs_of(folder: Path) -> Iterator[Path]:
    """Yield the raw logs in a folder and those below it, in order, without those that were recovered already."""
    found = (path for path in folder.rglob("*") if path.suffix.removeprefix(".") in _PROTOCOLS and path.is_file())
    yield from sorted(path for path in found if not path.stem.endswith(RECOVERED))


def recover(path: Path) -> Finding:
    """Judge one log; write its whole part beside it, as ``NAME.recovered.ubx``, if anything is wrong with it."""
    finding = Finding(path)
    try:
        _judge_and_write(finding)
    except OSError as error:
        for written in finding.written:
            with suppress(OSError):
                written.unlink()
        finding.written, finding.error = [], f"{error.strerror or error}"
    return finding


def _judge_and_write(finding: Finding) -> None:
    path = finding.path
    finding.bytes = path.stat().st_size
    sizes, end = _whole_frames(path)
    finding.frames, finding.cut_bytes = len(sizes), finding.bytes - end
    finding.gap_bytes = end - sum(sizes)
    if finding.cut_bytes:
        finding.faults.append(f"ends in {finding.cut_bytes} bytes that are no whole frame")
    times_path, tag_path = (path.with_name(path.name + ending) for ending in (".times", ".tag"))
    times = _times_that_fit(finding, times_path, sizes) if times_path.exists() else None
    tag = _tag_that_fits(finding, tag_path, end, times) if tag_path.exists() else None
    if finding.faults:
        _write(finding, end, times, tag)


def _whole_frames(path: Path) -> "tuple[array[int], int]":
    """Return the sizes of the whole frames, and where the last one ends."""
    framer, sizes, end = Framer([_PROTOCOLS[path.suffix[1:]]]), array("L"), 0
    held, start = b"", 0  # what is in no frame yet, and where it stands
    with path.open("rb") as file:
        while piece := file.read(_PIECE):
            held += piece
            at = _take(held, framer.feed(piece), sizes)
            held, start, end = held[at:], start + at, start + at if at else end
    at = _take(held, framer.flush(), sizes)
    return sizes, start + at if at else end


def _take(held: bytes, frames: list[Frame], sizes: "array[int]") -> int:
    """Add the sizes of frames; return where the last one ends in ``held``: they come in order, each at the next place with its bytes."""
    at = 0
    for frame in frames:
        at = held.index(frame.data, at) + len(frame.data)
        sizes.append(len(frame.data))
    return at


def _times_that_fit(finding: Finding, path: Path, sizes: "array[int]") -> bytes:
    """Return a line for each frame: those of the file as far as they agree with the frames, then the last one's instants again."""
    content = path.read_bytes()
    agreeing, stop, last = 0, 0, (0, 0, 0, 0)
    for row, end in _rows(content):
        if agreeing == len(sizes) or row[3] != sizes[agreeing]:
            break
        agreeing, stop, last = agreeing + 1, end, row
    if stop < len(content):
        finding.faults.append(f"{path.name}: {len(content) - stop} bytes at its end are of frames that are not there")
    if agreeing == len(sizes):
        return content[:stop]
    finding.faults.append(f"{path.name} lacks {len(sizes) - agreeing} frames: they get the instant of the last one before them")
    more = (b"%d %d %d %d\n" % (last[0] + number, last[1], last[2], size) for number, size in enumerate(sizes[agreeing:], 1))
    return content[:stop] + b"".join(more)


def _rows(content: bytes) -> Iterator[tuple[Row, int]]:
    """Yield the whole lines of a ``.times`` up to the first that is none, each with where it ends."""
    at = 0
    while (end := content.find(b"\n", at) + 1) > 0:
        fields = content[at:end].split()
        if len(fields) != 4 or not all(word.lstrip(b"-").isdigit() and len(word) < 21 for word in fields):
            return
        yield (int(fields[0]), int(fields[1]), int(fields[2]), int(fields[3])), end
        at = end


def _tag_that_fits(finding: Finding, path: Path, end: int, times: bytes | None) -> bytes | None:
    """Return the ``.tag`` as the ``.times`` say it, or without what it says of bytes that are not there; None where nothing is known."""
    content = path.read_bytes()
    if times:
        whole = _tag_of(times)
    else:
        tags = parse_tag(content, end)
        whole = content if tags is not None else _trimmed(content, end)
    if whole is not None and whole != content:
        finding.faults.append(f"{path.name} does not agree with the log")
    return whole


def _tag_of(times: bytes) -> bytes:
    rows = [row for row, _ in _rows(times)]
    writer = TagWriter(rows[0][1], rows[0][2])
    sizes = accumulate(row[3] for row in rows)
    return writer.header + b"".join(writer.record(row[2], size) for row, size in zip(rows, sizes, strict=True))


def _trimmed(content: bytes, end: int) -> bytes | None:
    """Return the longest beginning of a ``.tag`` that says nothing of what is behind ``end``."""
    low, high = 0, len(content)
    while low < high:  # the records of a .tag only grow
        middle = (low + high + 1) // 2
        low, high = (middle, high) if parse_tag(content[:middle], end) is not None else (low, middle - 1)
    return content[:low] or None


def _write(finding: Finding, end: int, times: bytes | None, tag: bytes | None) -> None:
    """Write the new files, down to the disk, the log last: where it stands, all of it does."""
    new = finding.path.with_name(f"{finding.path.stem}{RECOVERED}{finding.path.suffix}")
    if new.exists():
        finding.before = True
        finding.written = [new]
        return
    for ending, content in ((".times", times), (".tag", tag)):
        if content is not None:
            _put(finding, new.with_name(new.name + ending), iter([content]))
    with finding.path.open("rb") as source:
        _put(finding, new, _pieces(source, end))
    finding.written.reverse()


def _put(finding: Finding, path: Path, pieces: Iterator[bytes]) -> None:
    """Write a file under another name first, so that what has the right one is whole."""
    part = path.with_name(path.name + ".part")
    finding.written.append(part)
    with part.open("wb") as file:
        file.writelines(pieces)
        file.flush()
        os.fsync(file.fileno())
    part.rename(path)
    finding.written[-1] = path


def _pieces(source: BinaryIO, end: int) -> Iterator[bytes]:
    left = end
    while left and (piece := source.read(min(_PIECE, left))):
        yield piece
        left -= len(piece)
