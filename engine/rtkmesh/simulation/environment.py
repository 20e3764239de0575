"""What lies between satellites and antennas: troposphere and ionosphere beyond the standard models, and what hides the sky."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import cos, pi, sin
from typing import Final

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]

_WAVE_LENGTH_M: Final = 200.0e3
_WAVE_AMPLITUDE_M: Final = 0.03  # of the vertical L1 delay: slopes up to 1 mm/km
_WAVE_PERIODS_S: Final = (1200.0, 2900.0)
_SLOPE_PERIOD_S: Final = 6.0 * 3600.0  # in which what lasts for hours comes and goes
_SHELL_M: Final = 350.0e3  # height of the thin ionosphere
_ZENITH_SIGMA_M: Final = 0.02
_ZENITH_SLOPE: Final = 5e-7  # change of the zenith wet delay per metre of distance at most


@dataclass(frozen=True, slots=True)
class Window:
    """A repeated time in which the sky is (partly) hidden: ``duration_s`` from ``start_s`` of every ``period_s``."""

    period_s: float
    start_s: float
    duration_s: float
    hidden_below_rad: float  # pi / 2 and more hides all

    def holds(self, time_s: float) -> bool:
        """Return whether a time (s from the sky's REFERENCE) is within it."""
        return (time_s - self.start_s) % self.period_s < self.duration_s


def hidden_below_rad(windows: Sequence[Window], time_s: float) -> float:
    """Return the elevation below which nothing is seen at a time; -pi / 2 with an open sky."""
    return max((w.hidden_below_rad for w in windows if w.holds(time_s)), default=-pi / 2.0)


class Atmosphere:
    """Deviations from the standard models over one site, smooth in space and time, the same for all its receivers.

    ``activity`` scales the ionosphere's travelling waves: 1 is a quiet day of middle latitudes, 3 an active one. ``slope_ppm`` is the sigma
    of what its vertical delay on L1 has of a slope over the whole sky that lasts for hours, east and north.
    """

    def __init__(self, seed: int, activity: float = 1.0, slope_ppm: float = 0.0) -> None:
        self._amplitude_m = activity * _WAVE_AMPLITUDE_M
        rng = np.random.default_rng((seed, 7001))
        self._phases = rng.uniform(0.0, 2.0 * pi, 4)
        self._directions = rng.uniform(0.0, 2.0 * pi, 2)
        self._zenith_m = _ZENITH_SIGMA_M * float(rng.standard_normal())
        self._slope = _ZENITH_SLOPE * rng.uniform(-1.0, 1.0, 2)
        lasting = np.random.default_rng((seed, 7002))  # of its own: the rest is what it was without
        self._lasting, self._lasting_phase = 1e-6 * slope_ppm * lasting.standard_normal(2), float(lasting.uniform(0.0, 2.0 * pi))

    def zenith_wet_m(self, offset_enu_m: Vector, time_s: float) -> float:
        """Return what the zenith wet delay has beyond the standard, at a place of the site."""
        slow = 0.5 * _ZENITH_SIGMA_M * sin(2.0 * pi * time_s / 5400.0 + self._phases[2])
        return self._zenith_m + slow + float(self._slope[0] * offset_enu_m[0] + self._slope[1] * offset_enu_m[1])

    def _waves(self, offset_enu_m: Vector, time_s: float) -> Vector:
        """Return, per travelling wave of the ionosphere, what its phase at a pierce point needs: (2, 3) phase, rad/m east, rad/m north."""
        out = np.empty((2, 3))
        for k in range(2):
            east, north = sin(self._directions[k]), cos(self._directions[k])
            per_m = 2.0 * pi / _WAVE_LENGTH_M
            along_m = east * float(offset_enu_m[0]) + north * float(offset_enu_m[1])
            out[k] = (per_m * along_m + 2.0 * pi * time_s / _WAVE_PERIODS_S[k] + self._phases[k]) % (2.0 * pi), per_m * east, per_m * north
        return out

    def ionosphere_l1_m(self, offset_enu_m: Vector, time_s: float, azimuth_rad: Vector, elevation_rad: Vector) -> Vector:
        """Return what the slant L1 delay has beyond Klobuchar's at a place of the site, per satellite; thin shell of 350 km over it."""
        away_m = _SHELL_M / np.tan(np.maximum(elevation_rad, 0.1))
        east_m, north_m = away_m * np.sin(azimuth_rad), away_m * np.cos(azimuth_rad)
        waves = self._waves(offset_enu_m, time_s)
        vertical_m = sum(0.5 * self._amplitude_m * np.sin(w[0] + w[1] * east_m + w[2] * north_m) for w in waves)
        east, north = self._lasting * sin(2.0 * pi * time_s / _SLOPE_PERIOD_S + self._lasting_phase)
        vertical_m += east * (offset_enu_m[0] + east_m) + north * (offset_enu_m[1] + north_m)
        # The shell's obliquity: sine of the zenith angle at 350 km is 0.947 cos(el) (earth's radius 6371 km)
        return np.asarray(vertical_m / np.sqrt(1.0 - (0.9479 * np.cos(elevation_rad)) ** 2))
