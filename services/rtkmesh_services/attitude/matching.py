"""Epochs from readings: all sources' readings of one instant together, however they come.

An epoch is complete when every source that is due has spoken for it, or has spoken of a later instant. In what order sources speak
changes nothing. Live, an epoch waits no longer than a deadline; of a replay that runs as fast as it can, that deadline is long. What comes
for an epoch that is over is counted as late.

Candidates of the integers of a baseline come after its solution, which says that they do. Where they are wanted, the epoch waits for
them, no longer than for the last of its sources.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from math import inf

from rtkmesh.gnss.time import GpsTime
from rtkmesh_schemas.candidates import CandidatesMessage
from rtkmesh_services.attitude.readings import Reading
from rtkmesh_services.attitude.shelf import Shelf

TOLERANCE_S = 0.025  # instants that are the same: receivers' clocks differ by up to 1 ms
BACK_S = 10.0  # a time so far back is another beginning
_LOST_PERIODS = 3.0  # a source that has missed so many is not waited for
_KEPT, _RECENT = 64, 8  # instants of a source that are remembered, and those that its period is taken from
_SILENT_S = 2.0  # nor one that has been silent for so long, before its period is known


@dataclass(slots=True)
class _Track:
    """What is known of one source: its newest instant, how long from one to the next, when it was heard."""

    newest: GpsTime | None = None
    period_s: float | None = None
    past: list[GpsTime] = field(default_factory=list[GpsTime])


@dataclass(frozen=True, slots=True)
class MatchedEpoch:
    """All readings of one instant, by source. ``missing``: sources that were due; ``whole``: none of them may still speak for it.

    ``candidates`` of the sources, where they are ``wanted`` and have come. ``arrived_mono_ns``: of the last message that is in it.
    """

    time: GpsTime
    readings: dict[str, Reading]
    whole: bool
    missing: tuple[str, ...]
    wanted: bool = False
    candidates: dict[str, CandidatesMessage] = field(default_factory=dict[str, CandidatesMessage])
    arrived_mono_ns: int = 0


@dataclass(slots=True)
class _Pending:
    time: GpsTime
    opened_s: float
    readings: dict[str, Reading] = field(default_factory=dict[str, Reading])
    wanted: bool | None = None  # once all readings are there
    arrived_mono_ns: int = 0


def never(_: Mapping[str, Reading]) -> bool:
    """Want no candidates."""
    return False


class Matcher:
    """Gathers readings of named sources; ``slowest``: epochs are only those at which all of them speak.

    ``wanted``: whether the candidates of these readings are wanted.
    """

    def __init__(
        self, sources: Sequence[str], wait_s: float, *, slowest: bool, wanted: Callable[[Mapping[str, Reading]], bool] = never
    ) -> None:
        self._wanted = wanted
        self._candidates = Shelf(sources)
        self._tracks = {name: _Track() for name in sources}
        self._wait_s, self._slowest = wait_s, slowest
        self._pending: list[_Pending] = []
        self._closed: GpsTime | None = None
        self._opened_s = -inf  # when the epoch at _closed was begun
        self._begun_s: float | None = None
        self.late: Counter[str] = Counter()
        self.late_candidates: Counter[str] = Counter()
        self._was_wanted = False
        self.skipped = self.restarts = 0

    def take(self, reading: Reading, now_s: float, arrived_mono_ns: int = 0) -> Iterator[MatchedEpoch]:
        """Take a reading and yield the epochs that are complete now, in order of time."""
        self._begun_s = now_s if self._begun_s is None else self._begun_s
        if self._closed is not None and reading.time - self._closed < -BACK_S:
            self._begin_anew(now_s)
        if self._closed is not None and reading.time - self._closed <= TOLERANCE_S:
            self.late[reading.source.id] += 1
            if abs(reading.time - self._closed) <= TOLERANCE_S and now_s - self._opened_s < self._wait_s:
                self._note(reading)  # it was taken for lost, and is worth the wait
            return
        self._note(reading)
        pending = self._at(reading.time, now_s)
        pending.readings[reading.source.id], pending.wanted = reading, None
        pending.arrived_mono_ns = max(pending.arrived_mono_ns, arrived_mono_ns)
        yield from self.ready(now_s)

    def take_candidates(
        self, source: str, time: GpsTime, found: CandidatesMessage, now_s: float, arrived_mono_ns: int = 0
    ) -> Iterator[MatchedEpoch]:
        """Take the candidates of a source and yield the epochs that are complete now."""
        if self._closed is not None and -BACK_S <= time - self._closed <= TOLERANCE_S:
            self.late_candidates[source] += self._was_wanted
            return
        self._candidates.put(source, time, found)
        for pending in self._pending:
            if pending.wanted and abs(time - pending.time) <= TOLERANCE_S:
                pending.arrived_mono_ns = max(pending.arrived_mono_ns, arrived_mono_ns)
        yield from self.ready(now_s)

    def ready(self, now_s: float) -> Iterator[MatchedEpoch]:
        """Yield the epochs that are complete, or have waited for long enough."""
        while self._pending:
            first = self._pending[0]
            awaited = self._awaited(first, now_s)
            if awaited and now_s - first.opened_s < self._wait_s:
                return
            del self._pending[0]
            self._closed, self._opened_s, self._was_wanted = first.time, first.opened_s, self._wants(first)
            absent = [name for name, track in self._tracks.items() if name not in first.readings and not self._is_lost(track, first.time)]
            missing = tuple(name for name in absent if self._due(self._tracks[name], first.time))
            if self._slowest and len(absent) > len(missing):
                self.skipped += 1
                continue
            yield self._matched(first, missing, whole=not awaited)

    def due_s(self) -> float:
        """Return when the first pending epoch will have waited for long enough; inf without one."""
        return self._pending[0].opened_s + self._wait_s if self._pending else inf

    def _at(self, time: GpsTime, now_s: float) -> _Pending:
        """Return the pending epoch of an instant."""
        for pending in self._pending:
            if abs(time - pending.time) <= TOLERANCE_S:
                return pending
        made = _Pending(time, now_s)
        self._pending.append(made)
        self._pending.sort(key=lambda pending: (pending.time.week, pending.time.tow_s))
        return made

    def _note(self, reading: Reading) -> None:
        track = self._tracks[reading.source.id]
        if track.newest is None or reading.time > track.newest:
            track.newest = reading.time
            track.past = [*track.past[1 - _KEPT :], reading.time]
            recent = track.past[-_RECENT:]
            track.period_s = min((after - before for before, after in pairwise(recent)), default=None)

    def _awaited(self, pending: _Pending, now_s: float) -> list[str]:
        """Return the sources that may still speak for an epoch; once none may, those whose candidates it waits for."""
        silent = [name for name, track in self._tracks.items() if name not in pending.readings and self._may_speak(track, pending, now_s)]
        if silent or not self._wants(pending):
            return silent
        return [name for name, reading in pending.readings.items() if self._candidates.awaits(name, reading)]

    def _wants(self, pending: _Pending) -> bool:
        """Return whether candidates are wanted, which is asked once of the same readings."""
        if pending.wanted is None:
            follow = any(reading.candidates_follow for reading in pending.readings.values())
            pending.wanted = follow and self._wanted(pending.readings)
        return pending.wanted

    def _may_speak(self, track: _Track, pending: _Pending, now_s: float) -> bool:
        if track.newest is None:
            assert self._begun_s is not None, "a reading is pending"
            return now_s - self._begun_s < max(_SILENT_S, self._wait_s)
        if track.newest - pending.time > TOLERANCE_S:
            return False
        return self._due(track, pending.time)

    def _due(self, track: _Track, time: GpsTime) -> bool:
        """Return whether a source has a reading at an instant, by its period: not before its next one, not if it has long been lost."""
        before = next((past for past in reversed(track.past) if past < time), None)
        if before is None or track.period_s is None:
            return True
        since_s = time - before
        return track.period_s - TOLERANCE_S <= since_s <= (_LOST_PERIODS + 0.5) * track.period_s

    def _matched(self, pending: _Pending, missing: tuple[str, ...], *, whole: bool) -> MatchedEpoch:
        """Return an epoch, its readings in the sources' order: its time is that of the first of them."""
        readings = {name: pending.readings[name] for name in self._tracks if name in pending.readings}
        wanted = self._wants(pending)
        candidates = {name: found for name, reading in readings.items() if wanted and (found := self._candidates.take(name, reading.time))}
        return MatchedEpoch(next(iter(readings.values())).time, readings, whole, missing, wanted, candidates, pending.arrived_mono_ns)

    def _is_lost(self, track: _Track, time: GpsTime) -> bool:
        if track.newest is None or track.period_s is None:
            return track.newest is None
        return time - track.newest > (_LOST_PERIODS + 0.5) * track.period_s

    def _begin_anew(self, now_s: float) -> None:
        """Time has gone back: a recording is played again."""
        self._tracks = {name: _Track() for name in self._tracks}
        self._pending.clear()
        self._candidates = Shelf(tuple(self._tracks))
        self._closed, self._begun_s = None, now_s
        self.restarts += 1
