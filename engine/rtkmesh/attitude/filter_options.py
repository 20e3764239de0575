"""What the attitude filters are told, and what they answer."""

from dataclasses import dataclass, fields
from enum import StrEnum
from math import isfinite, nan, radians
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude.rotation import angles_of, angles_per_error
from rtkmesh.errors import OptionError
from rtkmesh.gnss.integrity import Integrity

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


class Kind(StrEnum):
    """Which filter: of the whole rotation, or of the heading alone."""

    ROTATION = "rotation"
    HEADING = "heading"


@dataclass(frozen=True, slots=True)
class FilterOptions:
    """How a filter is tuned.

    ``rate_walk_radps_rts``: random walk of the body's rate (rad/s per root second), per axis: how quickly the vehicle starts and stops to
    turn, for a start: the filter learns it; ``rate_sigma_radps``: of the rate at the start. ``bias_sigma_radps`` and
    ``bias_walk_radps_rts``: how large gyro biases are, and how quickly they walk. ``level_sigma_rad``: how level the vehicle is while
    nothing measures it. ``correlation_s``: for how long errors of measurements hang together. ``false_alarm``: probability of gating a
    good measurement; after ``persistence`` gated ones in a row that agree with each other the filter starts anew from the last.
    ``accept_float``, ``accept_unchecked``: whether measurements without fixed integers, or whose integrity is unavailable, are used.
    ``max_coast_s``, ``max_heading_sigma_rad``, ``max_tilt_sigma_rad``: without a measurement for longer, or less sure than that, there
    is no attitude. ``max_measured_sigma_rad``: measurements that say less are refused. ``history_s``: how late an input may be and
    still take its place. ``stuck_samples``: so many equal samples in a row, and a gyro is stuck.
    """

    kind: Kind = Kind.ROTATION
    rate_walk_radps_rts: float = 0.2  # 0.03 to 10 times it are learned: from a ship to a drone
    rate_sigma_radps: float = 0.5  # a vehicle may be in a turn of 30 deg/s when it is seen first
    bias_sigma_radps: float = 0.02  # MEMS gyros: a degree a second when they are switched on
    bias_walk_radps_rts: float = 1e-4  # and a minute of warming up moves that by 0.05 deg/s
    level_sigma_rad: float = radians(10.0)  # slopes and waves of ground vehicles and boats
    correlation_s: float = 0.0  # how long multipath lasts is not known here, and a vehicle that moves leaves it behind
    false_alarm: float = 1e-4  # at 10 Hz one good fix in a quarter of an hour, which the next one replaces
    persistence: int = 5  # half a second at 10 Hz: reflections that agree with each other for so long are rare, turns are not
    accept_float: bool = False  # floats are decimetres off: tens of degrees on a metre
    accept_unchecked: bool = True  # two antennas have nothing that could check them
    max_coast_s: float = 10.0  # a gyro has lost 0.3 deg by then; without one there is no attitude left long before (RESULTS.md)
    max_heading_sigma_rad: float = radians(5.0)  # more is no help to steering
    max_tilt_sigma_rad: float = radians(45.0)  # headings alone say nothing of tilt: level is assumed, which is no reason to say nothing
    max_measured_sigma_rad: float = radians(20.0)  # beyond it the small angles that the covariance is made of are not small
    history_s: float = 1.0  # the wait for late bases and candidates, and what a busy host adds
    stuck_samples: int = 10  # noise of a living gyro does not repeat ten times to the last digit

    def __post_init__(self) -> None:
        for name in (field.name for field in fields(self)):
            value = getattr(self, name)
            if isinstance(value, float) and not (isfinite(value) and (value > 0.0 or (value == 0.0 and name in _MAY_BE_ZERO))):
                raise OptionError(f"{name} = {value} of an attitude filter: it must be finite and above 0")
        if not self.false_alarm < 1.0:
            raise OptionError(f"false_alarm = {self.false_alarm}: it must be below 1")
        if self.persistence < 2 or self.stuck_samples < 2:
            raise OptionError("persistence and stuck_samples of an attitude filter must be 2 or more: a single one never decides")

    @property
    def bias_time_s(self) -> float:
        """The time constant with which a bias of this size walks so."""
        return 2.0 * (self.bias_sigma_radps / self.bias_walk_radps_rts) ** 2


_MAY_BE_ZERO: Final = ("correlation_s", "history_s")


class Outcome(StrEnum):
    """What became of an input."""

    STARTED = "started"
    ACCEPTED = "accepted"
    RESET = "reset"
    GATED = "gated"
    REFUSED = "refused"


class Why(StrEnum):
    """The reason of an outcome, and of there being no attitude."""

    OK = "ok"
    NOT_ALIGNED = "not aligned"
    INVALID = "invalid"
    SIGMA = "sigma"
    NOT_FIXED = "not fixed"
    INTEGRITY = "integrity"
    INNOVATION = "innovation"
    LATE = "late"
    GAP = "gap"
    STUCK = "stuck"
    VERTICAL = "vertical"
    ACCELERATED = "accelerated"


@dataclass(frozen=True, slots=True)
class Update:
    """What became of an input. ``jump_rad``: by how much a reset turned it; ``chi_square`` of the innovation, NaN if untested."""

    outcome: Outcome
    why: Why = Why.OK
    jump_rad: float = nan
    chi_square: float = nan
    degrees: int = 0

    @property
    def used(self) -> bool:
        """Whether the attitude follows from this input, too."""
        return self.outcome in (Outcome.STARTED, Outcome.ACCEPTED, Outcome.RESET)


@dataclass(frozen=True, slots=True)
class Trust:
    """How far a measurement is to be believed: its solution's status and integrity; ``may_reset``: whether it can overrule the filter."""

    fixed: bool = True
    integrity: Integrity = Integrity.OK
    may_reset: bool = True


TRUSTED: Final = Trust()


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """An attitude at an instant. There is none (None, NaN) unless ``why`` is OK.

    ``cov_rad2`` (3x3) is of the rotation's error in NED; ``rate_body_radps`` (forward, right, down) with its covariance (3x3);
    ``age_s``: since the last measurement that was used.
    """

    ned_from_body: Matrix | None
    cov_rad2: Matrix
    rate_body_radps: Vector
    rate_cov_radps2: Matrix
    age_s: float
    why: Why

    @property
    def usable(self) -> bool:
        """Whether there is an attitude."""
        return self.ned_from_body is not None

    @property
    def angles_rad(self) -> tuple[float, float, float]:
        """Heading, pitch, roll; NaN when there is none."""
        return (nan, nan, nan) if self.ned_from_body is None else angles_of(self.ned_from_body)

    @property
    def angles_cov_rad2(self) -> Matrix:
        """Covariance (3x3) of heading, pitch, roll; NaN when there is none."""
        if self.ned_from_body is None:
            return np.full((3, 3), nan)
        jacobian = angles_per_error(self.ned_from_body)
        return jacobian @ self.cov_rad2 @ jacobian.T


def nothing(why: Why, age_s: float = nan) -> Estimate:
    """Return the answer when there is no attitude, and why."""
    return Estimate(None, np.full((3, 3), nan), np.full(3, nan), np.full((3, 3), nan), age_s, why)
