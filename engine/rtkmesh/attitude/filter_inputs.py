"""What both attitude filters take in the same way: gyros, headings, and whether their last state still counts."""

from math import isfinite, nan
from typing import Final, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude.baseline import Mounting
from rtkmesh.attitude.filter_options import TRUSTED, FilterOptions, Outcome, Trust, Update, Why
from rtkmesh.attitude.innovation import Azimuth
from rtkmesh.attitude.keeper import Keeper, Measured, Model
from rtkmesh.attitude.rigid_body import Fit
from rtkmesh.gnss.time import GpsTime

Vector = NDArray[np.float64]
S = TypeVar("S", bound=Measured)

AHEAD: Final = Mounting()


class FilterInputs(Generic[S]):
    """The inputs of a filter of any states."""

    def __init__(self, model: Model[S], options: FilterOptions) -> None:
        self._options = options
        self._keeper = Keeper(model, options)
        self._stuck = StuckGyro(options.stuck_samples)

    @property
    def resets(self) -> int:
        """How often it started anew; each was told by its update."""
        return self._keeper.resets

    def gyro(self, time: GpsTime, rate_body_radps: Vector, sigma_radps: float) -> Update:
        """Take the rate (rad/s; forward, right, down) of a gyro with the sigma of a sample's noise, per axis."""
        objection = self._stuck.objection(rate_body_radps, sigma_radps)
        return self._keeper.gyro(time, rate_body_radps, sigma_radps) if objection is Why.OK else Update(Outcome.REFUSED, objection)

    def heading(self, time: GpsTime, azimuth_rad: float, sigma_rad: float, mounting: Mounting = AHEAD, trust: Trust = TRUSTED) -> Update:
        """Take the azimuth (rad, clockwise from north) of a baseline that is mounted so; by default the vehicle's heading itself."""
        return self._keeper.measure(time, Azimuth(mounting, azimuth_rad, sigma_rad), trust)

    def _fresh(self, time: GpsTime) -> tuple[S | None, float, float, Why]:
        """Return the last state before a time, the time on its scale (s), the age (s) of its last measurement, and why there is none."""
        before, time_s, why = self._keeper.state_at(time)
        if before is None:
            return None, time_s, nan, why
        age_s = time_s - before.measured_s
        return (None, time_s, age_s, Why.GAP) if age_s > self._options.max_coast_s else (before, time_s, age_s, Why.OK)


class StuckGyro:
    """Whether a gyro says anything: equal values in a row are none; the first other one is believed again."""

    def __init__(self, samples: int) -> None:
        self._samples, self._equal = samples, 0
        self._last = np.full(3, np.nan)

    def objection(self, rate_body_radps: Vector, sigma_radps: float) -> Why:
        """Return why a sample is not to be used, or OK."""
        if not (bool(np.all(np.isfinite(rate_body_radps))) and isfinite(sigma_radps) and sigma_radps > 0.0):
            return Why.INVALID
        self._equal = self._equal + 1 if np.array_equal(rate_body_radps, self._last) else 1
        self._last = rate_body_radps.copy()
        return Why.STUCK if self._equal >= self._samples else Why.OK


def finite_fit(fit: Fit) -> bool:
    """Whether all that a filter takes of a fit is finite."""
    unseen = fit.unseen_ned if fit.unseen_ned is not None else np.zeros(3)
    return all(bool(np.all(np.isfinite(part))) for part in (fit.ned_from_body, fit.cov[:3, :3], unseen))
