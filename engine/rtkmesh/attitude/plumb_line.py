"""Tilt from an accelerometer on a vehicle that moves: specific forces over half a second, less the vehicle's own acceleration.

A specific force is acceleration minus gravity. What of the acceleration is not known tilts the plumb line by its horizontal part over
gravity (0.5 m/s2: 2.9 deg), and it lasts for seconds, so that neighbouring values hardly average it down: the sigmas here say both.
"""

from dataclasses import dataclass
from math import exp, hypot, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude.filter_options import Trust
from rtkmesh.gnss.time import GpsTime

Vector = NDArray[np.float64]

# Accelerations last: many tilts in a row may be wrong alike, and never overrule a filter.
PLUMB: Final = Trust(may_reset=False)
GRAVITY_MPS2: Final = 9.81
WINDOW_S: Final = 0.5
_LARGEST_GAP_S: Final = 0.2  # between samples of one window
_ACCELERATION_S: Final = 3.0  # how long accelerations last


@dataclass(frozen=True, slots=True, eq=False)
class Force:
    """The mean specific force (m/s2; forward, right, down) over a window about ``time``."""

    time: GpsTime
    start: GpsTime
    end: GpsTime
    mean_mps2: Vector


class ForceWindows:
    """Gathers samples of an accelerometer into windows; a gap or a step back begins another one."""

    def __init__(self) -> None:
        self._start: GpsTime | None = None
        self._last: GpsTime | None = None
        self._sum, self._count = np.zeros(3), 0

    def take(self, time: GpsTime, force_mps2: Vector) -> Force | None:
        """Take a sample; return the window that is full with it."""
        if self._start is None or self._last is None or not 0.0 < time - self._last <= _LARGEST_GAP_S:
            self._begin(time)
        assert self._start is not None, "it has begun"
        self._sum, self._count, self._last = self._sum + force_mps2, self._count + 1, time
        if time - self._start < WINDOW_S:
            return None
        found = Force(self._start + 0.5 * (time - self._start), self._start, time, self._sum / self._count)
        self._begin(time)
        return found

    def _begin(self, time: GpsTime) -> None:
        self._start, self._sum, self._count = time, np.zeros(3), 0


def gravity_force(force_mps2: Vector, acceleration_ned_mps2: Vector, ned_from_body: NDArray[np.float64]) -> Vector:
    """Return the specific force (body, m/s2) that the vehicle would have without its acceleration."""
    return force_mps2 - ned_from_body.T @ acceleration_ned_mps2


def tilt_sigma_rad(force_sigma_mps2: float, acceleration_sigma_mps2: float, since_s: float) -> float:
    """Return the sigma (rad) of the plumb line of a window.

    ``acceleration_sigma_mps2``: of what of the vehicle's acceleration is not known; ``since_s``: from the last window that was used.
    Values that hang together are worth less: (1 + rho) / (1 - rho) times the variance, as of a first-order process.
    """
    rho = exp(-since_s / _ACCELERATION_S)
    return hypot(force_sigma_mps2, acceleration_sigma_mps2 * sqrt((1.0 + rho) / (1.0 - rho))) / GRAVITY_MPS2
