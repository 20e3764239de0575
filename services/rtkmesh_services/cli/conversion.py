"""Recordings to files of another format: what ``rtkmesh convert`` does between its options and its report."""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any, Protocol

import numpy as np

from rtkmesh.codecs.messages import Message
from rtkmesh.gnss.decimation import Decimator
from rtkmesh.gnss.ephemeris import GlonassEphemeris, KeplerEphemeris
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.signals import SATELLITES_PER_SYSTEM, SYSTEMS
from rtkmesh.gnss.time import GpsTime
from rtkmesh_services.cli.recordings import faults
from rtkmesh_services.ingest.recording import Recording, RecordingKind


@dataclass(frozen=True, slots=True)
class Selection:
    """Which epochs and which satellites are wanted; ``start`` and ``end`` are GPST, both included."""

    systems: str = SYSTEMS
    interval_s: float = 0.0
    start: GpsTime | None = None
    end: GpsTime | None = None


class Writer(Protocol):
    """Takes messages and makes files of them."""

    def take(self, message: Message) -> None:
        """Take the next message."""
        ...

    def finish(self, watch: Callable[[float], None]) -> list[tuple[Path, int]]:
        """Bring the files to their end; return those that were written, with their sizes. ``watch`` is told which part is done."""
        ...

    def abandon(self) -> None:
        """Leave nothing behind."""
        ...


@dataclass(slots=True)
class Tally:
    """What was converted."""

    counts: Counter[str] = field(default_factory=Counter[str])
    first: GpsTime | None = None
    last: GpsTime | None = None
    files: list[tuple[Path, int]] = field(default_factory=list[tuple[Path, int]])
    total_s: float = 0.0

    def count(self, message: Message) -> None:
        """Count one message that was passed on."""
        if isinstance(message, Epoch):
            self.counts["epochs"] += 1
            self.counts["observations"] += len(message)
            self.first = self.first or message.time
            self.last = message.time
        elif isinstance(message, KeplerEphemeris | GlonassEphemeris):
            self.counts["ephemerides"] += 1
        else:
            self.counts["others"] += 1

    def as_dict(self) -> dict[str, Any]:
        """Return the figures for programs."""
        times = {name: None if time is None else [time.week, time.tow_s] for name, time in (("first", self.first), ("last", self.last))}
        kinds = ("epochs", "observations", "ephemerides", "others")
        files = [{"path": str(path), "bytes": size} for path, size in self.files]
        return {**{kind: self.counts[kind] for kind in kinds}, **times, "files": files, "total_s": round(self.total_s, 3)}


class Conversion:
    """One run. Navigation files are read first, then the other recordings in their order, as one stream."""

    def __init__(self, recordings: list[Recording], selection: Selection, writer: Writer) -> None:
        self._recordings = sorted(recordings, key=lambda recording: recording.kind is not RecordingKind.NAVIGATION)
        self._writer, self._selection = writer, selection
        self._decimator = Decimator(selection.interval_s)
        everything = set(selection.systems) == set(SYSTEMS)
        self._systems = None if everything else np.array([SYSTEMS.index(letter) for letter in selection.systems])
        self.tally = Tally()

    def run(self, watch: Callable[[float], None]) -> Tally:
        """Convert everything; ``watch`` is told which part of the work is done, 0 to 1."""
        begun, size = perf_counter(), max(1, sum(recording.size for recording in self._recordings))
        try:
            for message in self._messages():
                if (kept := self._selected(message)) is None:
                    continue
                self.tally.count(kept)
                self._writer.take(kept)
                if isinstance(kept, Epoch):
                    watch(0.9 * sum(recording.position for recording in self._recordings) / size)
            self.tally.files = self._writer.finish(lambda part: watch(0.9 + 0.1 * part))
        except BaseException:
            self._writer.abandon()
            raise
        self.tally.total_s = perf_counter() - begun
        return self.tally

    def faults(self) -> dict[str, dict[str, int]]:
        """Return per file what was rejected while reading it, by reason."""
        return faults(self._recordings)

    def _messages(self) -> Iterator[Message]:
        for recording in self._recordings:
            yield from recording.messages()

    def _selected(self, message: Message) -> Message | None:
        """Return what is wanted of a message."""
        if isinstance(message, KeplerEphemeris | GlonassEphemeris):
            return message if SYSTEMS[message.satellite // SATELLITES_PER_SYSTEM] in self._selection.systems else None
        if not isinstance(message, Epoch):
            return message
        start, end = self._selection.start, self._selection.end
        if (start is not None and message.time < start) or (end is not None and message.time > end):
            return None
        if not self._decimator.takes(message.time):
            return None
        epoch = message
        if self._systems is not None:
            epoch = message.take(np.isin(message.satellite // SATELLITES_PER_SYSTEM, self._systems))
        return epoch if len(epoch) else None
