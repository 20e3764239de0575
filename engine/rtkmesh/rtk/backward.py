"""A recording backward: the engine of the forward run, through the same pairs of epochs in falling order of time.

What a forward run gave its engine is kept as a list of ``Taken``; ``Backward`` turns it round. The pairs are those of the forward run, and
the ephemerides are those that it knew at each epoch; only where it knew none of a satellite yet, that which came first is used.
"""

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.ephemeris import Ephemeris
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.time import GpsTime
from rtkmesh.models.ephemeris_table import KIND, NO_EPHEMERIS
from rtkmesh.rtk.complements import COMPLEMENT_S
from rtkmesh.rtk.engine import Rtk
from rtkmesh.rtk.options import Direction, RtkOptions
from rtkmesh.rtk.pairing import Pair
from rtkmesh.rtk.reversal import Reversal
from rtkmesh.rtk.session import Given, Session
from rtkmesh.rtk.solution import Solution

_NOTHING: Final = Given(None, None, None, (None, None))


@dataclass(frozen=True, slots=True, eq=False)
class Taken:
    """A pair of epochs as a forward run took it: with the first ``issues`` ephemerides, and ``given`` as place in its list of these."""

    rover: Epoch
    base: Epoch | None
    issues: int
    given: int
    age_s: float | None = None  # as Pair has it


@dataclass(slots=True)
class Course:
    """What a forward run of a session gives its engine, epoch by epoch. Mutable; the epochs themselves are kept by the caller."""

    session: Session
    givens: list[Given] = field(default_factory=list[Given])

    def __post_init__(self) -> None:
        self.session.issues = []

    @property
    def issues(self) -> list[Ephemeris]:
        """The ephemerides in the order in which they counted."""
        return self.session.issues or []

    def take(self, pair: Pair) -> Taken:
        """Return what the engine is given for a pair; to be asked once per pair, in the order of the run."""
        given = self.session.given(pair)
        if not self.givens or not _equal(given, self.givens[-1]):
            self.givens.append(given)
        return Taken(pair.rover, pair.base, len(self.issues), len(self.givens) - 1, pair.age_s)


def _equal(a: Given, b: Given) -> bool:
    same_place = _same(a.base_position_ecef_m, b.base_position_ecef_m)
    return same_place and a.klobuchar == b.klobuchar and a.glonass_bias == b.glonass_bias and a.antennas == b.antennas


def _same(a: NDArray[np.float64] | None, b: NDArray[np.float64] | None) -> bool:
    return a is b or (a is not None and b is not None and np.array_equal(a, b))


@dataclass(slots=True)
class Backward:
    """The backward run over a course that has ended. Mutable; ``solutions`` may be iterated once."""

    options: RtkOptions
    course: Course
    engine: Rtk = field(init=False)
    _rover: Reversal = field(default_factory=Reversal)
    _base: Reversal = field(default_factory=Reversal)
    _ahead: deque[Epoch] = field(default_factory=deque[Epoch])  # base epochs that were turned but not left behind, newest first
    _known: int = 0
    _kept: list[Ephemeris] = field(default_factory=list[Ephemeris])

    def __post_init__(self) -> None:
        self.engine = Rtk(self.options, Direction.BACKWARD)
        self._known = len(self.course.issues)

    def solutions(self, taken: Iterable[Taken]) -> Iterator[Solution]:
        """Yield the solutions of what a forward run took, given and answered in falling order of time."""
        given, place = _NOTHING, -1
        for item in self._turned(taken):
            self._know(item.issues, item.rover.time)
            if item.given != place:
                given, place = _filled(self.course.givens[item.given], given), item.given
                self.engine.antennas(*given.antennas)
            yield self.engine.step(
                item.rover, item.base, self.course.session.table, given.klobuchar, base_position_ecef_m=given.base_position_ecef_m,
                glonass_bias=given.glonass_bias, earlier_bases=self._earlier(item.base), age_s=item.age_s,
            )  # fmt: skip

    def _turned(self, taken: Iterable[Taken]) -> Iterator[Taken]:
        """Yield with turned epochs, when the base epochs that may complement an epoch's own are turned too."""
        waiting: deque[Taken] = deque()
        for item in taken:
            waiting.append(replace(item, rover=self._rover.turn(item.rover), base=self._turned_base(item.base)))
            while waiting[0].rover.time - item.rover.time > 2.0 * COMPLEMENT_S:
                yield waiting.popleft()
        yield from waiting

    def _turned_base(self, base: Epoch | None) -> Epoch | None:
        """Return a base epoch turned, each once."""
        if base is None:
            return None
        if not self._ahead or self._ahead[-1].time != base.time:
            self._ahead.append(self._base.turn(base))
        return self._ahead[-1]

    def _earlier(self, base: Epoch | None) -> Iterable[Epoch]:
        """Return base epochs that were recorded within some seconds before this one, newest first."""
        if base is None:
            return ()
        while len(self._ahead) > 1 and self._ahead[0].time > base.time:
            self._ahead.popleft()
        return [other for other in self._ahead if 0.0 < base.time - other.time <= COMPLEMENT_S]

    def _know(self, issues: int, time: GpsTime) -> None:
        """Forget the ephemerides that came later than this epoch, unless a satellite would be without; those are asked again later."""
        if issues == self._known:
            return
        came_later = self.course.issues[issues : self._known] + self._kept
        self._known, self._kept = issues, []
        for ephemeris in reversed(came_later):
            if not self._forget(ephemeris, time):
                self._kept.insert(0, ephemeris)

    def _forget(self, ephemeris: Ephemeris, time: GpsTime) -> bool:
        table, satellite = self.course.session.table, np.array([ephemeris.satellite], np.int16)
        if not table.withdraw(ephemeris):
            return True
        if table.select(satellite, time, include_unhealthy=True)[0, KIND] != NO_EPHEMERIS:
            return True
        table.add(ephemeris)
        return False


def _filled(given: Given, later: Given) -> Given:
    """Return what was given, with what the forward run did not know yet as it became known."""
    position = given.base_position_ecef_m if given.base_position_ecef_m is not None else later.base_position_ecef_m
    ends = given.antennas if given.antennas != (None, None) else later.antennas
    return Given(given.klobuchar or later.klobuchar, position, given.glonass_bias or later.glonass_bias, ends)
