"""The heading that a simulated receiver with two antennas computes itself, from antenna 1 to antenna 2."""

from math import asin, atan2, hypot, pi
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.frames import enu_from_ecef_at
from rtkmesh.gnss.receiver import CarrierSolution, ReceiverHeading
from rtkmesh.simulation.own_fix import rounded_ms
from rtkmesh.simulation.receiver import Observed
from rtkmesh.simulation.sky import absolute_s

Vector = NDArray[np.float64]

_SIGMA_M: Final = np.array((0.003, 0.003, 0.006))  # of the baseline, east, north, up
_WANDERING: Final = 0.5  # share of the variance that is multipath and wanders
_PERIODS_S: Final = np.array((37.0, 53.0, 71.0))
_FEWEST: Final = 5  # satellites in common for fixed integers


class OwnHeading:
    """Makes the receiver's own headings: the truth with an error that is white in one half and wanders in the other."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._phases = np.random.default_rng((seed, 982)).uniform(0.0, 2.0 * pi, 3)

    def __call__(self, main: Observed, second: Observed) -> ReceiverHeading:
        """Return the heading of an epoch; one without an angle where too few satellites are in common."""
        time = rounded_ms(main.epoch.time)
        common = len(np.intersect1d(main.epoch.satellite, second.epoch.satellite))
        if common < _FEWEST:
            return ReceiverHeading(time, "UNIHEADING", CarrierSolution.NONE, satellites=common)
        baseline = enu_from_ecef_at(main.position_ecef_m) @ (second.position_ecef_m - main.position_ecef_m)
        east, north, up = (baseline + self._error_m(absolute_s(main.true_time))).tolist()
        length_m, level_m = float(np.linalg.norm((east, north, up))), hypot(east, north)
        return ReceiverHeading(
            time, "UNIHEADING", CarrierSolution.FIXED, heading_rad=atan2(east, north) % (2.0 * pi), pitch_rad=asin(up / length_m),
            heading_sigma_rad=float(_SIGMA_M[0]) / level_m, pitch_sigma_rad=float(_SIGMA_M[2]) / length_m, length_m=length_m,
            satellites=common,
        )  # fmt: skip

    def _error_m(self, time_s: float) -> Vector:
        """Return the error of the baseline: a function of the time alone, so that a stream that begins later says the same."""
        white = np.random.default_rng((self._seed, 983, round(time_s * 1e3))).standard_normal(3)
        wander = np.sqrt(2.0) * np.sin(2.0 * pi * time_s / _PERIODS_S + self._phases)
        return _SIGMA_M * (np.sqrt(1.0 - _WANDERING) * white + np.sqrt(_WANDERING) * wander)
