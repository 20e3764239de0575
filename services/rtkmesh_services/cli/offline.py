"""Recordings through one solver session: what ``rtkmesh solve`` does between its options and its output."""

from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from time import perf_counter
from typing import Any, Final

from rtkmesh.codecs.messages import Message
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.session import EndOfStream, Session, SessionOptions, Source
from rtkmesh.rtk.solution import Reason, Solution, Status
from rtkmesh_services.errors import SourceError
from rtkmesh_services.ingest.recording import Recording, RecordingKind, open_recording

_WITHOUT_EPOCHS: Final = frozenset({RecordingKind.NAVIGATION, RecordingKind.NMEA})


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
    """What a run gave."""

    epochs: int = 0
    statuses: Counter[Status] = field(default_factory=Counter[Status])
    reasons: Counter[Reason] = field(default_factory=Counter[Reason])
    first: GpsTime | None = None
    last: GpsTime | None = None
    first_fix_s: float | None = None
    largest_age_s: float = 0.0
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
            self.first_fix_s = solution.time - self.first
        if solution.age_s > self.largest_age_s:
            self.largest_age_s = solution.age_s

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
            "reasons": {reason.name.lower(): count for reason, count in sorted(self.reasons.items())},
            "solve_ms_per_epoch": round(1e3 * self.solving_s / max(1, self.epochs), 4),
            "total_s": round(self.total_s, 3),
        }


def open_inputs(rover: Path, base: Path | None, navigation: tuple[Path, ...], date: GpsTime | None) -> Inputs:
    """Return the opened recordings. An RTCM 3 log without ``date`` takes it from the other receiver's recording, if that has one."""
    paths = [rover, *([base] if base else []), *navigation]
    receivers = paths[: 1 + bool(base)]
    with ExitStack() as stack:
        recordings: list[Recording] = []
        for path in paths:
            recordings.append(open_recording(path, date))
            stack.callback(recordings[-1].close)
            if path in receivers and recordings[-1].kind in _WITHOUT_EPOCHS:
                raise SourceError(f"{path} has no observations: it holds {recordings[-1].kind.value}")
        undated = {recording.path for recording in recordings if recording.kind is RecordingKind.RTCM3}
        if date is None and undated:
            date = next((time for path in paths if path not in undated and (time := _first_epoch(path)) is not None), None)
            if date is None:
                raise SourceError(f"{min(undated)}: an RTCM 3 log carries no date, and nothing else here does: say --date YYYY-MM-DD")
            return open_inputs(rover, base, navigation, date)
        stack.pop_all()
    return Inputs(recordings[0], recordings[1] if base else None, tuple(recordings[1 + bool(base) :]))


def _first_epoch(path: Path) -> GpsTime | None:
    return next((message.time for message in open_recording(path).messages() if isinstance(message, Epoch)), None)


@dataclass(slots=True)
class Run:
    """One run over recordings: ``solutions`` may be iterated once; ``tally`` counts what it has given so far."""

    inputs: Inputs
    options: SessionOptions
    tally: Tally = field(default_factory=Tally)
    session: Session = field(init=False)

    def __post_init__(self) -> None:
        self.session = Session(self.options)

    def solutions(self) -> Iterator[Solution]:
        """Yield the solutions of all rover epochs in time order."""
        session = self.session
        begun = perf_counter()
        for source, message in _merged(self.inputs):
            session.feed(source, message)
            if isinstance(message, Epoch | EndOfStream):
                yield from self._ready(session)
            self.tally.total_s = perf_counter() - begun
            if session.rover_ended and not len(session.pairing):
                return

    def _ready(self, session: Session) -> Iterator[Solution]:
        started = perf_counter()
        while (pair := session.next_pair(0.0)) is not None:
            solution = session.solve(pair)
            self.tally.solving_s += perf_counter() - started
            self.tally.count(solution)
            yield solution
            started = perf_counter()

    def faults(self) -> dict[str, dict[str, int]]:
        """Return per file what was rejected while reading it, by reason."""
        rejected = {recording.path.name: dict(recording.decoding.rejected) for recording in self.inputs.all()}
        return {name: counts for name, counts in rejected.items() if counts}


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
