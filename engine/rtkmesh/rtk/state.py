"""What the filter carries from epoch to epoch: state, covariance, and the history of each keyed state."""

from dataclasses import dataclass, field, replace
from math import nan, sqrt
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place, scratch_flags
from rtkmesh.gnss.signals import KEYS_PER_SATELLITE, MAX_SATELLITE
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.code_arcs import new_codes
from rtkmesh.rtk.filter import merge_keys, rearrange

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

ZENITH_KEY: Final = 0
EXCESS_KEY: Final = MAX_SATELLITE  # the part by which the ionosphere exceeds its model, over the whole sky
SLOPE_KEYS: Final = (MAX_SATELLITE + 1, MAX_SATELLITE + 2)  # of GLONASS phases on G1 and on G2
FIRST_PAIR_KEY: Final = KEYS_PER_SATELLITE  # below: zenith delay, ionospheres (satellite numbers) and their excess, GLONASS slopes

# Columns of the history, one row per key; times in seconds since the filter's origin, unknown is NaN. ROVER_M and BASE_M are the last
# phases minus model (m; ``ephemeris_change`` and ``ionosphere_change`` keep them those of the newest models); ARC_EPOCHS counts epochs
# since the ambiguity was begun anew, REJECTS those in a row in which its phase did not fit; INTEGER is the held integer (cycles, common
# offset per group), NaN where none. STREAK is what the last search said (0 for a group's reference), NaN where it was not in the search.
# HALF_CYC is 0.5 while the phase is half a cycle off the integer that it had. TAKEN_M is the mean of code errors that the ambiguity has
# taken, TAKEN_M2 (m2) what the filter believes of its variance (``code_errors``). From AWAY_ROVER and AWAY_BASE on are the steps (m;
# displacement and clock) of the receivers since the satellite was seen. In the row of an ionosphere USUAL_M is its usual size.
(
    SEEN_S, ROVER_S, BASE_S, ROVER_M, BASE_M, ROVER_LOCK_S, BASE_LOCK_S, ARC_EPOCHS, REJECTS, SLIPS, INTEGER, ARC_S, STREAK, HALF_CYC,
    TAKEN_M, TAKEN_M2,
) = range(16)  # fmt: skip
USUAL_M: Final = TAKEN_M
STEP: Final = 4
AWAY_ROVER: Final = 16
AWAY_BASE: Final = AWAY_ROVER + STEP
HISTORY: Final = AWAY_BASE + STEP
DYNAMIC: Final = 9  # baseline, velocity, acceleration come before the keyed states
# Sigmas of position (m), velocity (m/s) and acceleration (m/s2) of a new filter: of what moves, stands, and has a known position.
SEED_MOVING: Final = np.array((30.0, 10.0, 3.0))
SEED_STANDING: Final = np.array((30.0, 1e-6, 1e-6))
SEED_FIXED: Final = np.array((1e-4, 1e-6, 1e-6))


class Filter(NamedTuple):
    """State and covariance, ordered as ``filter`` says, the keys of the states from DYNAMIC on, and a row of history per key.

    The arrays are written to in place; a filter of other keys is another tuple.
    """

    x: Vector
    P: Matrix
    keys: Indices
    history: Matrix


_NO_KEYS: Final = np.zeros(0, np.int64)  # of all filters that begin: nothing can be written to them
_NO_HISTORY: Final = np.zeros((0, HISTORY))


def new_filter() -> Filter:
    """Return a filter without keyed states that knows nothing."""
    return Filter(np.zeros(DYNAMIC), np.zeros((DYNAMIC, DYNAMIC)), _NO_KEYS, _NO_HISTORY)


def filter_at(baseline_ecef_m: Vector, sigmas: Vector) -> Filter:
    """Return a filter without keyed states that stands there, with these sigmas of position, velocity and acceleration."""
    x, P = np.zeros(DYNAMIC), np.zeros((DYNAMIC, DYNAMIC))
    x[:3] = baseline_ecef_m
    P.reshape(-1)[:: DYNAMIC + 1] = (sigmas * sigmas).repeat(3)
    return Filter(x, P, _NO_KEYS, _NO_HISTORY)


@kernel
def use_keys(f: Filter, current: Indices, time_s: float, maximum_gap_s: float) -> Filter:
    """Return the filter with room for the current keys (sorted), without those that were not seen for too long."""
    keep, kept, known = scratch_flags(len(f.keys)), 0, 0
    for k in range(len(keep)):
        keep[k] = time_s - f.history[k, SEEN_S] <= maximum_gap_s
        if known < len(current) and current[known] == f.keys[k]:
            keep[k] = True
            known += 1
        kept += 1 if keep[k] else 0
    if kept == len(keep) and known == len(current):
        return f
    keys, source = merge_keys(f.keys, keep, current)
    x, P = rearrange(f.x, f.P, source, DYNAMIC)
    history = np.full((len(keys), HISTORY), np.nan)
    for k in range(len(keys)):
        if source[k] >= 0:
            history[k, :] = f.history[source[k]]
        else:
            history[k, ARC_EPOCHS] = -1.0  # to be initialised
            history[k, REJECTS], history[k, SLIPS] = 0.0, 0.0
    return Filter(x, P, keys, history)


@kernel_in_place
def is_ionosphere(key: int) -> bool:
    """Return whether a key is that of a satellite's ionosphere."""
    return ZENITH_KEY < key < MAX_SATELLITE


@kernel_in_place
def place_of(keys: Indices, key: int) -> int:
    """Return where a key is in the sorted keys, -1 if it is not there."""
    low, high = 0, len(keys)
    while low < high:
        middle = (low + high) // 2
        if keys[middle] < key:
            low = middle + 1
        else:
            high = middle
    return low if low < len(keys) and keys[low] == key else -1


def of_the_rover(f: Filter, sigma_m: float) -> Filter:
    """Return a filter that has of this one what does not depend on the base; ``sigma_m`` is added to that of the position."""
    P = f.P[:DYNAMIC, :DYNAMIC].copy()
    for i in range(3):
        P[i, i] += sigma_m**2
    return Filter(f.x[:DYNAMIC].copy(), P, np.zeros(0, np.int64), np.zeros((0, HISTORY)))


@dataclass(slots=True, eq=False)
class FilterState:
    """What the engine carries of one filter. Mutable. Times in seconds since ``origin``; the model position is the last epoch's.

    ``place``: states and covariance by which integers of the last epoch put the rover somewhere (``placing``).
    """

    origin: GpsTime
    filter: Filter = field(default_factory=new_filter)
    informed: Filter = field(default_factory=new_filter)
    place: tuple[Vector, Matrix] = field(default_factory=lambda: new_filter()[:2])
    time_s: float = 0.0
    base_ecef_m: Vector = field(default_factory=lambda: np.full(3, np.nan))
    rover_model_ecef_m: Vector = field(default_factory=lambda: np.full(3, np.nan))
    rover_s: float = float("nan")
    base_s: float = float("nan")
    codes_s: Matrix = field(default_factory=new_codes)

    def for_other_base(self, sigma_m: float) -> "FilterState":
        """Return a state of its own that keeps what does not depend on the base; ``sigma_m`` is added to that of the position."""
        rover = of_the_rover(self.filter, sigma_m)
        informed, base_ecef_m, model_ecef_m = of_the_rover(self.filter, sigma_m), self.base_ecef_m.copy(), self.rover_model_ecef_m.copy()
        return replace(
            self, filter=rover, informed=informed, base_ecef_m=base_ecef_m, rover_model_ecef_m=model_ecef_m, base_s=nan, codes_s=new_codes()
        )

    @property
    def rover_ecef_m(self) -> Vector:
        """Position of the rover's antenna."""
        return self.base_ecef_m + self.filter.x[:3]

    @property
    def baseline_m(self) -> float:
        """Length of the baseline."""
        return length_m(self.filter.x[:3])


def length_m(vector: Vector) -> float:
    """Return the length of a vector."""
    return sqrt(float(vector.dot(vector)))


def trace(matrix: Matrix) -> float:
    """Return the trace of a 3 x 3 matrix."""
    return float(matrix[0, 0] + matrix[1, 1] + matrix[2, 2])
