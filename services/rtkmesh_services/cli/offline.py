"""Recordings through one solver session: what ``rtkmesh solve`` does between its options and its output."""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import chain
from pathlib import Path
from time import perf_counter
from typing import Any, Final

from rtkmesh.codecs.messages import Message
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.backward import Backward, Course, Taken
from rtkmesh.rtk.combination import combine_runs
from rtkmesh.rtk.pairing import Pair
from rtkmesh.rtk.session import EndOfStream, Session, SessionOptions, Source
from rtkmesh.rtk.solution import Reason, Solution, Status
from rtkmesh.rtk.track import Track, solutions_of
from rtkmesh_services.cli.lookahead import looking_ahead
from rtkmesh_services.cli.recordings import faults, open_recordings
from rtkmesh_services.cli.spool import Spool
from rtkmesh_services.errors import SourceError
from rtkmesh_services.ingest.recording import Recording, RecordingKind

_WITHOUT_EPOCHS: Final = frozenset({RecordingKind.NAVIGATION, RecordingKind.NMEA})
# Sentences that tell no time and that no solution takes anything from; of an M8's log they are a half, and took a tenth of its run.
_OF_NO_USE: Final = frozenset(
    f"nmea/{talker}{kind}" for talker in ("GP", "GL", "GA", "GB", "BD", "GQ", "GI", "GN") for kind in ("GSV", "GSA", "GLL", "VTG", "GST")
)


class SolutionType(StrEnum):
    """Which way through the recordings (RTKLIB's pos1-soltype)."""

    FORWARD = "forward"
    BACKWARD = "backward"
    COMBINED = "combined"


@dataclass(frozen=True, slots=True)
class Inputs:
    """The opened recordings of one run; ``base`` is None in mode single."""

    rover: Recording
    base: Recording | None
    navigation: tuple[Recording, ...]

    def all(self) -> Iterator[Recording]:
        """Yield the recordings that are there."""
        yield self.rover
        if self.base is not None:
            yield self.base
        yield from self.navigation

    @property
    def size(self) -> int:
        """Bytes of rover and base together: the measure of progress."""
        return self.rover.size + (self.base.size if self.base else 0)

    @property
    def position(self) -> int:
        """Bytes of rover and base that have been read."""
        return self.rover.position + (self.base.position if self.base else 0)


@dataclass(slots=True)
class Tally:
    """What a run gave; ``first_fix_s`` is counted the way that the run went."""

    epochs: int = 0
    statuses: Counter[Status] = field(default_factory=Counter[Status])
    reasons: Counter[Reason] = field(default_factory=Counter[Reason])
    first: GpsTime | None = None
    last: GpsTime | None = None
    first_fix_s: float | None = None
    largest_age_s: float = 0.0
    resets: int = 0
    solving_s: float = 0.0
    total_s: float = 0.0

    def count(self, solution: Solution) -> None:
        """Take in one solution."""
        self.epochs += 1
        self.statuses[solution.status] += 1
        if solution.status not in (Status.FIX, Status.FLOAT):
            self.reasons[solution.reason] += 1
        self.first = self.first or solution.time
        self.last = solution.time
        if solution.status is Status.FIX and self.first_fix_s is None:
            self.first_fix_s = abs(solution.time - self.first)
        if solution.age_s > self.largest_age_s:
            self.largest_age_s = solution.age_s
        if solution.resets > self.resets:
            self.resets = solution.resets

    @property
    def solved(self) -> int:
        """Epochs with any solution."""
        return self.epochs - self.statuses[Status.NONE]

    def percent(self, status: Status) -> float:
        """Share of the epochs with this status."""
        return 100.0 * self.statuses[status] / self.epochs if self.epochs else 0.0

    def as_dict(self) -> dict[str, Any]:
        """Return the figures for programs."""
        return {
            "epochs": self.epochs,
            "solved": self.solved,
            **{f"{status.name.lower()}_pct": round(self.percent(status), 3) for status in Status},
            "first_fix_s": self.first_fix_s,
            "largest_age_s": round(self.largest_age_s, 3),
            "resets": self.resets,
            "reasons": {reason.name.lower(): count for reason, count in sorted(self.reasons.items())},
            "solve_ms_per_epoch": round(1e3 * self.solving_s / max(1, self.epochs), 4),
            "total_s": round(self.total_s, 3),
        }


def open_inputs(rover: Path, base: Path | None, navigation: tuple[Path, ...], date: GpsTime | None, receiver_options: str = "") -> Inputs:
    """Return the opened recordings. An RTCM 3 log without ``date`` takes it from the other receiver's recording, if that has one."""
    paths = [rover, *([base] if base else []), *navigation]
    recordings = open_recordings(paths, date, receiver_options, _OF_NO_USE)
    for recording in recordings[: 1 + bool(base)]:
        if recording.kind in _WITHOUT_EPOCHS:
            for other in recordings:
                other.close()
            raise SourceError(f"{recording.path} has no observations: it holds {recording.kind.value}")
    return Inputs(recordings[0], recordings[1] if base else None, tuple(recordings[1 + bool(base) :]))


def _nobody() -> None:
    """Watch nothing."""


@dataclass(slots=True)
class Run:
    """One run over recordings: ``solutions`` may be iterated once.

    ``tally`` counts what it has given so far; ``passes`` what each way through the recordings gave, where there are two; ``combined`` how
    many epochs were combined how (``combination.How``). ``watch`` is called after every epoch, of either way. ``causal``: nothing is
    known before it is told, as in a replay.
    """

    inputs: Inputs
    options: SessionOptions
    kind: SolutionType = SolutionType.FORWARD
    watch: Callable[[], None] = _nobody
    causal: bool = False
    tally: Tally = field(default_factory=Tally)
    passes: dict[SolutionType, Tally] = field(default_factory=dict[SolutionType, Tally])
    combined: dict[str, int] = field(default_factory=dict[str, int])
    session: Session = field(init=False)
    turned: float = 0.0  # part of the way back that is done
    _begun_s: float = 0.0

    def __post_init__(self) -> None:
        self.session = Session(self.options)

    @property
    def progress(self) -> float:
        """Which part of the work is done, 0 to 1."""
        read = self.inputs.position / max(1, self.inputs.size)
        return read if self.kind is SolutionType.FORWARD else 0.5 * (read + self.turned)

    def solutions(self) -> Iterator[Solution]:
        """Yield the solutions of all rover epochs in rising order of time."""
        self._begun_s = perf_counter()
        for solution in self._forward() if self.kind is SolutionType.FORWARD else self._both():
            self.tally.total_s = perf_counter() - self._begun_s
            yield solution

    def _forward(self) -> Iterator[Solution]:
        for pair in self._pairs(self.tally):
            yield self._solved(pair, self.tally)

    def _both(self) -> Iterator[Solution]:
        """Go forward, keeping what the engine takes, and back over that; yield what came of it."""
        course, forward, combining = Course(self.session), Track(), self.kind is SolutionType.COMBINED
        there, back = Tally(), Tally() if combining else self.tally
        with Spool[Taken]() as spool:
            for pair in self._pairs(there):
                spool.append(course.take(pair))
                if combining:
                    forward.append(self._solved(pair, there))
                else:
                    self.watch()
            there.total_s = perf_counter() - self._begun_s
            backward = self._backward(course, spool, back)
        if not combining:
            yield from solutions_of(backward.table[::-1])
            return
        self.passes = {SolutionType.FORWARD: there, SolutionType.BACKWARD: back}
        result = combine_runs(forward.table, backward.table[::-1])
        self.combined = result.counts()
        self.tally.solving_s += there.solving_s + back.solving_s
        for solution in solutions_of(result.table):
            self.tally.count(solution)
            yield solution

    def _backward(self, course: Course, spool: Spool[Taken], tally: Tally) -> Track:
        """Return the solutions of the way back, in falling order of time."""
        track, begun, started = Track(), perf_counter(), perf_counter()
        for solution in Backward(self.options.rtk, course).solutions(spool.backward()):
            tally.solving_s += perf_counter() - started
            tally.count(solution)
            track.append(solution)
            self.turned = len(track) / len(spool)
            self.watch()
            started = perf_counter()
        tally.total_s = perf_counter() - begun
        return track

    def _solved(self, pair: Pair, tally: Tally) -> Solution:
        started = perf_counter()
        solution = self.session.solve(pair)
        tally.solving_s += perf_counter() - started
        tally.count(solution)
        self.watch()
        return solution

    def _pairs(self, tally: Tally) -> Iterator[Pair]:
        """Yield all rover epochs with their base epochs, when what precedes them has been read; pairing is part of solving."""
        session, items = self.session, _merged(self.inputs)
        for source, message in items if self.causal else looking_ahead(items):
            session.feed(source, message)
            if isinstance(message, Epoch | EndOfStream):
                started = perf_counter()
                while (pair := session.next_pair(0.0)) is not None:
                    tally.solving_s += perf_counter() - started
                    yield pair
                    started = perf_counter()
            if session.rover_ended and not len(session.pairing):
                return

    def faults(self) -> dict[str, dict[str, int]]:
        """Return per file what was rejected while reading it, by reason."""
        return faults(self.inputs.all())


def _merged(inputs: Inputs) -> Iterator[tuple[Source, Message | EndOfStream]]:
    """Yield navigation files first, then rover and base by epoch time; what precedes an epoch in its stream goes with it.

    The session's result does not depend on this order; its memory does.
    """
    for recording in inputs.navigation:
        for message in chain(recording.messages(), [EndOfStream()]):
            yield Source.NAVIGATION, message
    streams: dict[Source, Iterator[Message | EndOfStream]] = {Source.ROVER: chain(inputs.rover.messages(), [EndOfStream()])}
    if inputs.base is not None:
        streams[Source.BASE] = chain(inputs.base.messages(), [EndOfStream()])
    reached: dict[Source, GpsTime] = dict.fromkeys(streams, GpsTime(0, 0.0))
    while streams:
        source = min(streams, key=reached.__getitem__)
        for message in streams[source]:
            yield source, message
            if isinstance(message, EndOfStream):
                del streams[source], reached[source]
            elif isinstance(message, Epoch):
                reached[source] = message.time
            else:
                continue
            break
