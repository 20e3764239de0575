"""What the filter carries from epoch to epoch: state, covariance, and the history of each keyed state."""

from dataclasses import dataclass, field
from math import sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.signals import MAX_SATELLITE
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.filter import merge_keys, rearrange

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

ZENITH_KEY: Final = 0
SLOPE_KEY: Final = 64  # GLONASS satellite number 0: no satellite
FIRST_PAIR_KEY: Final = MAX_SATELLITE  # below: ionosphere states (satellite numbers), the GLONASS slope and the zenith delay

# Columns of the history, one row per key; times in seconds since the filter's origin, unknown is NaN. ROVER_M and BASE_M are the last
# phases minus model (m), ISSUE the ephemeris they were made with; ARC_EPOCHS counts epochs since the ambiguity was begun anew, REJECTS
# those in a row in which its phase did not fit; INTEGER is the held integer (cycles, common offset per group), NaN where none.
SEEN_S, ROVER_S, BASE_S, ROVER_M, BASE_M, ROVER_LOCK_S, BASE_LOCK_S, ISSUE, ARC_EPOCHS, REJECTS, SLIPS, INTEGER, ARC_S = range(13)
HISTORY: Final = 13


@dataclass(slots=True, eq=False)
class FilterState:
    """The mutable state of one filter. ``x`` and ``cov`` are ordered as ``filter`` says; ``keys`` belong to the states from ``dynamic``
    on.
    """

    origin: GpsTime
    dynamic: int
    x: Vector
    cov: Matrix
    time_s: float = 0.0
    keys: Indices = field(default_factory=lambda: np.zeros(0, np.int64))
    history: Matrix = field(default_factory=lambda: np.zeros((0, HISTORY)))
    base_ecef_m: Vector = field(default_factory=lambda: np.full(3, np.nan))
    rover_model_ecef_m: Vector = field(default_factory=lambda: np.full(3, np.nan))
    rover_s: float = float("nan")
    base_s: float = float("nan")

    def use_keys(self, current: Indices, maximum_gap_s: float) -> None:
        """Make room for the current keys (sorted) and forget those that were not seen for too long."""
        keep = self.time_s - self.history[:, SEEN_S] <= maximum_gap_s
        keys, source = merge_keys(self.keys, keep, current)
        if np.array_equal(keys, self.keys):
            return
        self.x, self.cov = rearrange(self.x, self.cov, source, self.dynamic)
        history = np.full((len(keys), HISTORY), np.nan)
        known = source >= 0
        history[known] = self.history[source[known]]
        history[~known, ARC_EPOCHS] = -1.0  # to be initialised
        history[~known, REJECTS] = 0.0
        history[~known, SLIPS] = 0.0
        self.keys, self.history = keys, history

    def place(self, keys: Indices) -> Indices:
        """Return where these keys (all present) are."""
        return np.searchsorted(self.keys, keys)

    @property
    def baseline_m(self) -> float:
        """Length of the baseline."""
        return length_m(self.x[:3])


def length_m(vector: Vector) -> float:
    """Return the length of a vector."""
    return sqrt(float(vector.dot(vector)))


def trace(matrix: Matrix) -> float:
    """Return the trace of a 3 x 3 matrix."""
    return float(matrix[0, 0] + matrix[1, 1] + matrix[2, 2])
