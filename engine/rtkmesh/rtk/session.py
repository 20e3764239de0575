"""One solver instance as a pure object: messages of its receivers in, solutions out.

The services and the offline solver run this same object, which is why their solutions are equal to the last bit. An
ephemeris or a base position counts only for epochs that follow it: in its own stream for the rover's, in GNSS time for those of
another stream. So the order of arrival between streams changes nothing.
"""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Final

import numpy as np

from rtkmesh.errors import OptionError
from rtkmesh.gnss.ephemeris import (
    Ephemeris,
    GlonassBias,
    GlonassEphemeris,
    KeplerEphemeris,
    KlobucharParameters,
    ReceiverFix,
    ReferenceStation,
)
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.receiver import ReceiverReport
from rtkmesh.gnss.time import GpsTime
from rtkmesh.models.antenna import Antenna
from rtkmesh.models.ephemeris_table import EphemerisTable
from rtkmesh.rtk.base_change import Candidate, Jump, same_antenna
from rtkmesh.rtk.comparison import Comparison
from rtkmesh.rtk.continuation import Continuation
from rtkmesh.rtk.engine import Rtk
from rtkmesh.rtk.options import Mode, RtkOptions
from rtkmesh.rtk.pairing import Pair, Pairing, PairingOptions
from rtkmesh.rtk.resampling import resampled
from rtkmesh.rtk.solution import Solution


class Source(StrEnum):
    """What a stream is to the solver."""

    ROVER = "rover"
    BASE = "base"
    NAVIGATION = "navigation"


@dataclass(frozen=True, slots=True)
class EndOfStream:
    """A stream has ended (replays only)."""


_MOST_PENDING: Final = 4096  # navigation data that wait for a rover epoch, live: a rover may be away for days

Navigation = KeplerEphemeris | GlonassEphemeris | KlobucharParameters | ReferenceStation | GlonassBias
Input = Epoch | Navigation | ReceiverFix | ReceiverReport | EndOfStream
FindAntenna = Callable[[str, str], Antenna | str]  # IGS name and serial number to the antenna, or to why there is none


@dataclass(frozen=True, slots=True)
class SessionOptions:
    """What is around the engine.

    ``base_position_ecef_m``: known position of the base antenna, instead of what its stream says; ``navigation_streams``: in replay,
    solving starts only when so many navigation streams have ended; ``rover_antenna`` and ``base_antenna``: IGS names of the antennas,
    instead of what the streams say; ``find_antenna`` knows calibrations, None: no antenna is corrected.
    """

    rtk: RtkOptions = field(default_factory=RtkOptions)
    pairing: PairingOptions = field(default_factory=PairingOptions)
    base_position_ecef_m: tuple[float, float, float] | None = None
    navigation_streams: int = 0
    rover_antenna: str = ""
    base_antenna: str = ""
    find_antenna: FindAntenna | None = None


def pairing_for(
    options: RtkOptions, *, replay: bool, maximum_wait_s: float = 1.0, matched_only: bool = False, interpolate: bool = False
) -> PairingOptions:
    """Return the pairing that suits a mode: none for single, equal epochs only for a moving base."""
    return PairingOptions(
        tolerance_s=options.time_tolerance_s,
        maximum_wait_s=maximum_wait_s,
        matched_only=matched_only or options.mode is Mode.MOVING_BASE,
        silent_s=options.max_age_s,
        has_base=options.mode is not Mode.SINGLE,
        replay=replay,
        interpolate=interpolate,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Given:
    """What the engine is given beside the epochs and the ephemerides."""

    klobuchar: KlobucharParameters | None
    base_position_ecef_m: "np.ndarray[tuple[int], np.dtype[np.float64]] | None"
    glonass_bias: GlonassBias | None
    antennas: tuple[Antenna | None, Antenna | None]


@dataclass(slots=True)
class Session:
    """Pairing, navigation data and engine of one solver instance. Mutable.

    ``issues``, where it is a list, receives the ephemerides in the order in which they counted, each issue once.
    """

    options: SessionOptions
    table: EphemerisTable = field(default_factory=EphemerisTable)
    pairing: Pairing = field(init=False)
    engine: Rtk = field(init=False)
    klobuchar: KlobucharParameters | None = None
    station: ReferenceStation | None = None
    glonass_bias: GlonassBias | None = None
    issues: list[Ephemeris] | None = None
    _rover_pending: deque[tuple[int, Navigation]] = field(default_factory=deque[tuple[int, Navigation]])
    _other_pending: deque[tuple[GpsTime | None, Source, Navigation]] = field(
        default_factory=deque[tuple[GpsTime | None, Source, Navigation]]
    )
    _base_time: GpsTime | None = None
    _said: dict[Source, tuple[str, str]] = field(default_factory=dict[Source, tuple[str, str]])
    _antennas: dict[Source, Antenna | str] = field(default_factory=dict[Source, Antenna | str])
    _ended_navigation: int = 0
    rover_ended: bool = False
    _comparison: Comparison | None = None
    same_antenna: bool = False
    _jump: Jump | None = None
    _placed: tuple[float, float, float] | None = None  # the base position of the newest epoch, and as the engine takes it
    _place_ecef_m: "np.ndarray[tuple[int], np.dtype[np.float64]] | None" = None
    _told: GpsTime | None = None  # of the newest base epoch that was given: what receivers said up to then has been heard

    def __post_init__(self) -> None:
        self.pairing = Pairing(self.options.pairing)
        self.engine = Rtk(self.options.rtk)
        self._use_antennas()

    @property
    def antennas(self) -> dict[str, str]:
        """What is known of the antennas of rover and base, for people; empty where nothing was said of one."""
        return {source.value: str(self._antennas.get(source, "")) for source in (Source.ROVER, Source.BASE)}

    @property
    def corrects_antennas(self) -> bool:
        """Whether positions are of antenna reference points: the antennas of both ends are known."""
        return len(self._antennas) == 2 and all(isinstance(one, Antenna) for one in self._antennas.values())

    def feed(self, source: Source, message: Input, now_s: float = 0.0) -> None:
        """Take one message of a stream, in that stream's order; ``now_s`` is the deadline clock (s), unused in replay."""
        if isinstance(message, EndOfStream):
            self._end(source)
        elif isinstance(message, Epoch):
            self._epoch(source, message, now_s)
        elif isinstance(message, Navigation):
            self._navigation(source, message)

    def solutions(self, now_s: float = 0.0) -> Iterator[Solution]:
        """Yield the solutions of all rover epochs whose waiting is over, oldest first."""
        while (pair := self.next_pair(now_s)) is not None:
            yield self.solve(pair)

    def next_pair(self, now_s: float) -> Pair | None:
        """Return the next rover epoch to solve, or None; a base that can be interpolated is, so that its epoch is the rover's."""
        if self.options.pairing.replay and self._ended_navigation < self.options.navigation_streams:
            return None
        pair = self.pairing.next_pair(now_s)
        if pair is None or pair.base is None:
            return pair
        pair = pair if pair.later is None else self._interpolated(pair, pair.base, pair.later)
        self._told = None if pair.base is None else pair.base.time
        return pair

    def given(self, pair: Pair) -> Given:
        """Return what counts for a pair: what all navigation data that precede it say; the ephemerides are in the table then."""
        self._apply(pair)
        return Given(self.klobuchar, self._base_position(), self.glonass_bias, self._ends())

    def solve(self, pair: Pair) -> Solution:
        """Return the solution of one pair, with all navigation data that precede it."""
        self._apply(pair)
        solution = self.engine.step(
            pair.rover, pair.base, self.table, self.klobuchar, base_position_ecef_m=self._base_position(), glonass_bias=self.glonass_bias,
            age_s=pair.age_s,
        )  # fmt: skip
        if self._comparison is not None:
            self._compare(self._comparison, pair, solution)
        return replace(solution, waited_s=pair.waited_s) if pair.waited_s != 0.0 else solution

    def _interpolated(self, pair: Pair, base: Epoch, later: Epoch) -> Pair:
        """Return the pair with the base at the rover's instant; with the earlier base epoch where that cannot be."""
        self._apply(pair)
        place, time = self._base_position(), pair.rover.time
        if place is None:
            return replace(pair, later=None)
        told = self._told is not None and self._told >= base.time
        made = resampled(base, later, time, self.table.issues, place, self.klobuchar, slips_told=told)
        ages_s = time - base.time, time - later.time
        return replace(pair, later=None) if made is None else replace(pair, base=made, later=None, age_s=min(ages_s, key=abs))

    def deadline_s(self) -> float:
        """Return the instant of the deadline clock at which ``solutions`` must be asked again; inf if none."""
        return self.pairing.deadline_s()

    def restart(self, options: SessionOptions | None = None) -> None:
        """Begin with a fresh filter, with new options if given; navigation data are kept, waiting epochs are not."""
        self.options = options or self.options
        self.pairing = Pairing(self.options.pairing)
        self.engine = Rtk(self.options.rtk)
        self._comparison = self._jump = self._told = None
        self._use_antennas()
        self._rover_pending = deque((0, message) for _, message in self._rover_pending)

    def go_on(self, options: SessionOptions) -> Continuation:
        """Take other options without a fresh filter, where the engine can; else change nothing and say why.

        Waiting epochs stay and wait as the new options say.
        """
        now = self.options
        if (now.rover_antenna, now.base_antenna) != (options.rover_antenna, options.base_antenna):
            return Continuation("ambiguities stand for the phase centres of other antennas")
        found = self.engine.go_on(options.rtk)
        if not found.obstacle:
            self.options, self.pairing.options = options, options.pairing
        return found

    def change_base(self, options: SessionOptions, candidate: Candidate | None) -> None:
        """Go on with another base (None: with none). ``options`` say what is configured of it; the rover's own data stay.

        What that does to the position is in ``take_jump`` after the next solutions.
        """
        before = self._base_position()
        bases = self.pairing.change_base()
        self.options = options
        self._forget_base()
        theirs = [] if candidate is None else [epoch for epoch, _ in candidate.epochs]
        place = None if candidate is None else candidate.position_ecef_m
        self.same_antenna = same_antenna(bases, theirs, (before, place))
        if not self.same_antenna:
            self._comparison = Comparison(self.engine, bases, before) if bases and candidate is not None else None
            self.engine = self.engine.with_other_base()
        if candidate is not None:
            self._take_over(candidate)
        self._use_antennas()

    def take_jump(self) -> Jump | None:
        """Return what the newest epoch says of a change of the base, once; None where there is nothing new to say."""
        jump, self._jump = self._jump, None
        return jump

    def _forget_base(self) -> None:
        self._comparison = self._jump = self.station = self.glonass_bias = self._base_time = self._told = None
        of_base = ReferenceStation | GlonassBias
        kept = [row for row in self._other_pending if not (row[1] is Source.BASE and isinstance(row[2], of_base))]
        self._other_pending = deque((None, source, message) for _, source, message in kept)
        self._said.pop(Source.BASE, None)
        self._antennas.pop(Source.BASE, None)

    def _take_over(self, candidate: Candidate) -> None:
        for message in (candidate.station, candidate.bias):
            if message is not None:
                self._take(Source.BASE, message)
        for epoch, now_s in candidate.epochs:
            self._epoch(Source.BASE, epoch, now_s)

    def _compare(self, comparison: Comparison, pair: Pair, solution: Solution) -> None:
        self._jump = comparison.jump(pair.rover, solution, self.table, self.klobuchar)
        if self._jump.decided:
            self._comparison = None

    def _end(self, source: Source) -> None:
        if source is Source.BASE:
            self.pairing.end_base()
        elif source is Source.NAVIGATION:
            self._ended_navigation += 1
        else:
            self.rover_ended = True

    def _epoch(self, source: Source, epoch: Epoch, now_s: float) -> None:
        if source is Source.ROVER:
            self.pairing.add_rover(epoch, now_s)
        elif source is Source.BASE:
            self.pairing.add_base(epoch, now_s)
            self._base_time = epoch.time if self._base_time is None else max(self._base_time, epoch.time)

    def _navigation(self, source: Source, message: Navigation) -> None:
        if source is Source.ROVER:
            self._rover_pending.append((self.pairing.rover_order, message))
        else:
            after = self._base_time if source is Source.BASE else None
            self._other_pending.append((after, source, message))
            if len(self._other_pending) > _MOST_PENDING and not self.options.pairing.replay:
                self._take(*self._other_pending.popleft()[1:])

    def _apply(self, pair: Pair) -> None:
        """Take over the navigation data that count for this pair: earlier in the rover's stream, earlier in time in others."""
        while self._rover_pending and self._rover_pending[0][0] < pair.order:
            self._take(Source.ROVER, self._rover_pending.popleft()[1])
        if not self._other_pending:
            return
        newest = pair.rover.time if pair.base is None else max(pair.rover.time, pair.base.time)
        limit = newest + -self.options.pairing.tolerance_s
        while self._other_pending and ((after := self._other_pending[0][0]) is None or after < limit):
            _, source, message = self._other_pending.popleft()
            self._take(source, message)

    def _take(self, source: Source, message: Navigation) -> None:
        if isinstance(message, KeplerEphemeris | GlonassEphemeris):
            if self.table.add(message) and self.issues is not None:
                self.issues.append(message)
        elif isinstance(message, KlobucharParameters):
            if self.klobuchar is None or message.system == "G" or self.klobuchar.system != "G":
                self.klobuchar = message
        elif isinstance(message, ReferenceStation):
            self._station(source, message)
        elif source is Source.BASE:
            self.glonass_bias = message

    def _station(self, source: Source, station: ReferenceStation) -> None:
        if source is Source.BASE:
            self.station = station
        said = (station.antenna, station.antenna_serial)
        if station.antenna and self._said.get(source) != said:
            self._said[source] = said
            self._use_antennas()

    def _use_antennas(self) -> None:
        """Tell the engine of the antennas that were configured or named by the streams."""
        find, options = self.options.find_antenna, self.options
        if find is None or options.rtk.mode is Mode.SINGLE:
            return
        for source, given in ((Source.ROVER, options.rover_antenna), (Source.BASE, options.base_antenna)):
            name, serial = (given, "") if given else self._said.get(source, ("", ""))
            found = find(name, serial) if name else ""
            if given and isinstance(found, str):
                raise OptionError(f"{source}_antenna: {found}")
            if str(found) != str(self._antennas.get(source, "")):  # the engine begins anew with another antenna, not with its name
                self._antennas[source] = found
        self.engine.antennas(*self._ends())

    def _ends(self) -> tuple[Antenna | None, Antenna | None]:
        """Return the antennas of rover and base that are known."""
        rover, base = self._antennas.get(Source.ROVER), self._antennas.get(Source.BASE)
        return rover if isinstance(rover, Antenna) else None, base if isinstance(base, Antenna) else None

    def _base_position(self) -> "np.ndarray[tuple[int], np.dtype[np.float64]] | None":
        position = self.options.base_position_ecef_m
        if position is None and self.station is not None:
            position = self.station.position_ecef_m
        if position is None:
            return None
        if position != self._placed:
            self._placed, self._place_ecef_m = position, np.array(position)
        return self._place_ecef_m
