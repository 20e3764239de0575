"""Corrections on their way to a receiver whose link may be slow. Filled by the work loop, emptied by the writer's thread.

Rules of this file: what the station says of itself goes first, the newest of each number; an epoch (all systems at one instant) is
written whole or not at all; where the link does not carry all of it, the oldest epoch that was not begun goes.
"""

import threading
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Final

from rtkmesh_services.ingest.correction_gate import Correction
from rtkmesh_services.ntrip.frames import MAXIMUM_AGE_S, MAXIMUM_BYTES, STATION_NUMBERS

MAXIMUM_WAIT_S: Final = 2.0  # what waits is no more than the link carries in this time


@dataclass(slots=True)
class _Group:
    """Frames of one epoch, or a single frame of none."""

    epoch: int
    received_s: float
    begun: bool = False
    frames: deque[Correction] = field(default_factory=deque[Correction])


@dataclass(slots=True)
class CorrectionCounts:
    """What became of corrections, by message number. ``replaced``: a newer one of the station came before they were written."""

    queued: Counter[int] = field(default_factory=Counter[int])
    written: Counter[int] = field(default_factory=Counter[int])
    dropped: Counter[int] = field(default_factory=Counter[int])
    replaced: Counter[int] = field(default_factory=Counter[int])
    written_bytes: int = 0
    dropped_epochs: int = 0
    newest_wait_s: float | None = None  # how long the frame written last had waited


class CorrectionQueue:
    """The corrections that wait. ``bytes_per_s`` is what the link carries, 0: not known, None: as the open port says."""

    def __init__(self, bytes_per_s: float | None = None) -> None:
        self.bytes_per_s = bytes_per_s
        self.counts = CorrectionCounts()
        self._lock = threading.Lock()
        self._station: dict[int, Correction] = {}
        self._groups: deque[_Group] = deque()
        self._rate = bytes_per_s or 0.0
        self._bytes = 0
        self._begun = self._gone = 0  # newest epochs that were begun, or dropped
        self._wake: Callable[[], None] | None = None

    @property
    def waiting(self) -> bool:
        """Whether something is to be written."""
        return bool(self._station or self._groups)

    @property
    def rate(self) -> float:
        """What the link carries, bytes per second; 0: not known."""
        return self._rate

    def opened(self, link_bytes_per_s: float, wake: Callable[[], None]) -> None:
        """A connection is there that carries so much: epochs from before it are late. ``wake`` tells its writer of new ones."""
        with self._lock:
            self._rate = link_bytes_per_s if self.bytes_per_s is None else self.bytes_per_s
            self._wake = wake
            while self._groups:
                self._drop(0)

    def put(self, correction: Correction, now_s: float) -> None:
        """Take a frame; what the link will not carry in time goes."""
        with self._lock:
            self.counts.queued[correction.number] += 1
            if correction.number in STATION_NUMBERS:
                self.counts.replaced[correction.number] += correction.number in self._station
                self._station[correction.number] = correction
            elif 0 < correction.epoch <= self._gone:  # of an epoch that was dropped before it was whole
                self.counts.dropped[correction.number] += 1
            else:
                self._append(correction)
                self._drop_old(now_s)
        if self._wake is not None:
            self._wake()

    def get(self, now_s: float) -> Correction | None:
        """Return the frame that is to be written next, None when there is none."""
        with self._lock:
            if self._station:
                return self._station.pop(next(iter(self._station)))
            self._drop_old(now_s)
            if not self._groups:
                return None
            group = self._groups[0]
            group.begun, self._begun = True, max(self._begun, group.epoch)
            found = group.frames.popleft()
            self._bytes -= len(found.frame)
            if not group.frames:
                self._groups.popleft()
            return found

    def written(self, correction: Correction, now_s: float) -> None:
        """Count a frame that was written."""
        with self._lock:
            self.counts.written[correction.number] += 1
            self.counts.written_bytes += len(correction.frame)
            self.counts.newest_wait_s = now_s - correction.received_s

    def lost(self, correction: Correction) -> None:
        """Count a frame that could not be written."""
        with self._lock:
            self.counts.dropped[correction.number] += 1

    def told(self) -> CorrectionCounts:
        """Return a copy of the counts as they are now."""
        with self._lock:
            counts = self.counts
            return replace(
                counts,
                queued=Counter(counts.queued),
                written=Counter(counts.written),
                dropped=Counter(counts.dropped),
                replaced=Counter(counts.replaced),
            )

    def restart(self) -> None:
        """Another base speaks from now on: its epochs are counted anew, and nothing of the one before is sent."""
        with self._lock:
            self.counts.dropped.update(self._station.keys())
            self._station.clear()
            while self._groups:
                self._drop(0)
            self._begun = self._gone = 0

    def _append(self, correction: Correction) -> None:
        epoch = correction.epoch
        group = next((group for group in reversed(self._groups) if epoch and group.epoch == epoch), None)
        if group is None:
            group = _Group(epoch, correction.received_s, begun=0 < epoch <= self._begun)
            self._groups.append(group)
        group.frames.append(correction)
        self._bytes += len(correction.frame)

    def _drop_old(self, now_s: float) -> None:
        limit = min(MAXIMUM_BYTES, self._rate * MAXIMUM_WAIT_S) if self._rate > 0.0 else MAXIMUM_BYTES
        first = int(bool(self._groups) and self._groups[0].begun)
        while len(self._groups) > first + 1 and self._bytes > limit:
            self._drop(first)
        while self._groups and now_s - self._groups[0].received_s > MAXIMUM_AGE_S:
            self._drop(0)

    def _drop(self, index: int) -> None:
        group = self._groups[index]
        del self._groups[index]
        self._bytes -= sum(len(correction.frame) for correction in group.frames)
        self.counts.dropped.update(correction.number for correction in group.frames)
        self.counts.dropped_epochs += group.epoch > 0
        self._gone = max(self._gone, group.epoch)
