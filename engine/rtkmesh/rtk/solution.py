"""What one epoch gives: a position or a baseline with everything one must know to trust it."""

from dataclasses import dataclass, field
from enum import IntEnum
from math import nan
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.integrity import Integrity
from rtkmesh.gnss.signals import MAX_SATELLITE
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.state import DYNAMIC, ZENITH_KEY

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


class Status(IntEnum):
    """Kind of solution, numbered as RTKLIB's Q."""

    NONE = 0
    FIX = 1
    FLOAT = 2
    SBAS = 3
    DGPS = 4
    SINGLE = 5


class Reason(IntEnum):
    """Why an epoch has no better solution (data faults are values)."""

    OK = 0
    NO_EPHEMERIS = 1
    FEW_SATELLITES = 2
    NO_CONVERGENCE = 3
    NO_BASE = 4
    BASE_TOO_OLD = 5
    NO_BASE_POSITION = 6
    FEW_COMMON_SATELLITES = 7
    FEW_AMBIGUITIES = 8
    RATIO = 9
    FLOAT_TOO_UNCERTAIN = 10
    VALIDATION = 11
    FILTER_RESET = 12
    RESIDUALS = 13
    AMBIGUITY_OFF = 14
    FAILURE_RATE = 15


class IntegrityReason(IntEnum):
    """Why integrity is not OK: not available up to ALERT_LIMIT, a failed test from RESIDUALS on."""

    OK = 0
    NO_SOLUTION = 1
    NOT_WATCHED = 2
    NO_REDUNDANCY = 3
    ALERT_LIMIT = 4
    RESIDUALS = 5
    FLOAT = 6
    CODES = 7
    LENGTH = 8


# Bits of SatelliteTable.state.
USED_CODE, USED_PHASE, FIXED, SLIPPED, REJECTED, HALF_CYCLE = 1, 2, 4, 8, 16, 32


# Columns of the packed satellite table.
(
    T_SATELLITE, T_SIGNAL, T_STATE, T_AZIMUTH_RAD, T_ELEVATION_RAD, T_CN0_DBHZ, T_CODE_M, T_PHASE_M, T_AMBIGUITY_CYC, T_LOCK_S, T_SLIPS,
    T_VARIANCE_CYC2, T_LOCK_EPOCHS, T_REJECTS,
) = range(14)  # fmt: skip
TABLE: Final = 14


@dataclass(slots=True, eq=False)
class SatelliteTable:
    """Per satellite and signal: what the filter made of it, a value. Unknown is NaN; ``packed`` has a row per signal, the columns T_*.

    Azimuth and elevation are in radians, C/N0 in dB-Hz, residuals in metres, the single-difference ambiguity in cycles, the age of its arc
    in seconds; ``state`` is of the bits above.
    """

    packed: Matrix

    @property
    def satellite(self) -> NDArray[np.int16]:
        """Satellite numbers."""
        return self.packed[:, T_SATELLITE].astype(np.int16)

    @property
    def signal(self) -> NDArray[np.int16]:
        """Signal numbers of the rover."""
        return self.packed[:, T_SIGNAL].astype(np.int16)

    @property
    def state(self) -> NDArray[np.uint8]:
        """What was used, and how."""
        return self.packed[:, T_STATE].astype(np.uint8)

    @property
    def azimuth_rad(self) -> Vector:
        """Azimuth, clockwise from north."""
        return self.packed[:, T_AZIMUTH_RAD]

    @property
    def elevation_rad(self) -> Vector:
        """Elevation."""
        return self.packed[:, T_ELEVATION_RAD]

    @property
    def cn0_dbhz(self) -> Vector:
        """The lower C/N0 of rover and base."""
        return self.packed[:, T_CN0_DBHZ]

    @property
    def code_residual_m(self) -> Vector:
        """Residuals of the code differences."""
        return self.packed[:, T_CODE_M]

    @property
    def phase_residual_m(self) -> Vector:
        """Residuals of the phase differences."""
        return self.packed[:, T_PHASE_M]

    @property
    def ambiguity_cyc(self) -> Vector:
        """Float ambiguities."""
        return self.packed[:, T_AMBIGUITY_CYC]

    @property
    def lock_s(self) -> Vector:
        """Time since the ambiguity began."""
        return self.packed[:, T_LOCK_S]

    @property
    def slips(self) -> NDArray[np.int32]:
        """Slips since the satellite came."""
        return self.packed[:, T_SLIPS].astype(np.int32)

    @property
    def ambiguity_variance_cyc2(self) -> Vector:
        """Variances of the float ambiguities."""
        return self.packed[:, T_VARIANCE_CYC2]

    @property
    def lock_epochs(self) -> NDArray[np.int32]:
        """Epochs since the ambiguity began."""
        return self.packed[:, T_LOCK_EPOCHS].astype(np.int32)

    @property
    def rejects(self) -> NDArray[np.int32]:
        """Epochs in a row in which the phase did not fit."""
        return self.packed[:, T_REJECTS].astype(np.int32)


def no_satellites() -> SatelliteTable:
    """Return the empty table."""
    return SatelliteTable(np.zeros((0, TABLE)))


_nan3: Final = np.full(3, nan).copy  # a copy costs a tenth of another array
_nan7: Final = np.full(7, nan).copy
_nan9: Final = np.full(DYNAMIC, nan).copy
_nan33: Final = np.full((3, 3), nan).copy


@dataclass(slots=True, eq=False)
class FloatState:
    """The filter beside the integers: where the float solution is, and the states that long baselines and GLONASS need. Unknown is NaN.

    Taken from the states of the filter when it is asked: ``x`` begins with its baseline, velocity and acceleration on the filter's clock,
    which ``sense`` (1 or -1) turns to GPS time; ``moves``: it knows of motion. ``keys`` and ``shared`` are keys and values of the states
    beside those, of the filter that knows the atmosphere.
    """

    base_ecef_m: Vector = field(default_factory=_nan3)
    x: Vector = field(default_factory=_nan9)
    keys: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    shared: Vector = field(default_factory=lambda: np.zeros(0))
    sense: float = 1.0
    moves: bool = False

    @property
    def position_ecef_m(self) -> Vector:
        """Position."""
        return self.base_ecef_m + self.x[:3]

    @property
    def velocity_ecef_mps(self) -> Vector:
        """Velocity (of a moving base: of the baseline)."""
        return self.sense * self.x[3:6] if self.moves else _nan3()

    @property
    def acceleration_ecef_mps2(self) -> Vector:
        """Acceleration (of a moving base: of the baseline)."""
        return self.x[6:9] if self.moves else _nan3()

    @property
    def zenith_m(self) -> float:
        """Zenith delay of the rover against the base, beyond the model."""
        return self._value(ZENITH_KEY)

    @property
    def satellites(self) -> NDArray[np.int64]:
        """Satellites whose ionosphere is a state."""
        return self.keys[self._is_ionosphere]

    @property
    def ionosphere_m(self) -> Vector:
        """Delays of ``satellites`` on L1, along the ray, rover against base and beyond the model."""
        return self.shared[self._is_ionosphere]

    @property
    def _is_ionosphere(self) -> NDArray[np.bool_]:
        return (self.keys > ZENITH_KEY) & (self.keys < MAX_SATELLITE)

    def _value(self, key: int) -> float:
        found = self.shared[self.keys == key]
        return float(found[0]) if len(found) else nan


@dataclass(slots=True, eq=False)
class Solution:
    """The solution of one rover epoch. Vectors are ECEF, metres and seconds; covariances are full 3x3; unknown is NaN.

    A value: nobody writes to it (a frozen dataclass of so many fields takes 8 us to make, this one 1).

    ``time`` is the receiver's epoch tag (GPST) that pairs it with others; ``age_s`` is rover minus base epoch;
    ``baseline_ecef_m`` is rover minus base. The velocity is that of the rover's antenna, of a moving base too, at the instant at which it
    measured (``pace``); the acceleration is the filter's, of a moving base that of the baseline. ``ratio`` is second-best over best squared
    norm of the integer search (0: none).
    ``single_position_ecef_m`` is this epoch's single-point position, ``clocks_s`` (in the order of ``gnss.signals.SYSTEMS``) receiver clock
    minus each system's time. ``grade`` 0 to 3: how many independent validations a fix passed.
    ``glonass_slopes_m``: what phases on G1 and on G2 are off per frequency channel by the held integers (float solutions cannot tell).
    ``waited_s`` is the time between the rover epoch's arrival and its solving on the deadline clock.

    ``fix_probability``: that the integers of a fix are right, as calibrated; 0 without a fix. The protection levels (of a moving base: of
    the baseline) are exceeded with the configured risk under what docs/concepts/integrity.md assumes; infinite where nothing bounds
    the error, NaN where nothing was computed. ``integrity`` says whether the tests passed and the levels are inside the alert limits.
    """

    time: GpsTime
    status: Status = Status.NONE
    reason: Reason = Reason.OK
    position_ecef_m: Vector = field(default_factory=_nan3)
    position_cov_ecef_m2: Matrix = field(default_factory=_nan33)
    velocity_ecef_mps: Vector = field(default_factory=_nan3)
    velocity_cov_ecef_m2ps2: Matrix = field(default_factory=_nan33)
    acceleration_ecef_mps2: Vector = field(default_factory=_nan3)
    acceleration_cov_ecef_m2ps4: Matrix = field(default_factory=_nan33)
    base_ecef_m: Vector = field(default_factory=_nan3)
    baseline_ecef_m: Vector = field(default_factory=_nan3)
    baseline_cov_ecef_m2: Matrix = field(default_factory=_nan33)
    single_position_ecef_m: Vector = field(default_factory=_nan3)
    receiver_clock_s: float = float("nan")
    clocks_s: Vector = field(default_factory=_nan7)
    age_s: float = float("nan")
    ratio: float = 0.0
    ratio_threshold: float = 0.0
    success_rate: float = 0.0
    grade: int = 0
    ambiguities: int = 0
    ambiguities_fixed: int = 0
    satellites_used: int = 0
    satellites_rover: int = 0
    satellites_base: int = 0
    code_rms_m: float = float("nan")
    phase_rms_m: float = float("nan")
    nis_per_observation: float = float("nan")
    resets: int = 0
    waited_s: float = 0.0
    fix_probability: float = 0.0
    protection_horizontal_m: float = float("nan")
    protection_vertical_m: float = float("nan")
    integrity: Integrity = Integrity.UNAVAILABLE
    integrity_reason: IntegrityReason = IntegrityReason.NO_SOLUTION
    glonass_slopes_m: tuple[float, float] = (nan, nan)
    satellites: SatelliteTable = field(default_factory=no_satellites)
    float_state: FloatState = field(default_factory=FloatState)
