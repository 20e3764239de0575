"""The tilt that an accelerometer gives the filter, once the vehicle's acceleration over the same half second is known, or will not be."""

from collections.abc import Iterator
from math import inf

import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude.filter import AttitudeFilter
from rtkmesh.attitude.filter_options import Update
from rtkmesh.attitude.plumb_line import PLUMB, Force, ForceWindows, gravity_force, tilt_sigma_rad
from rtkmesh.gnss.time import GpsTime
from rtkmesh_schemas.config_attitude import ImuTable
from rtkmesh_services.attitude.motion import Motion

_WAIT_S = 0.4  # for the velocities of a window: with its half it stays within the filter's history


class Tilts:
    """Windows of specific force, and the accelerations of ``motion`` that are taken from them."""

    def __init__(self, table: ImuTable) -> None:
        self.motion = Motion()
        self._table = table
        self._windows = ForceWindows()
        self._pending: list[Force] = []
        self._newest: GpsTime | None = None
        self._last: GpsTime | None = None

    def take(self, time: GpsTime, force_mps2: NDArray[np.float64]) -> None:
        """Take a sample of the accelerometer."""
        self._newest = time
        if (window := self._windows.take(time, force_mps2)) is not None:
            self._pending.append(window)

    def applied(self, attitude: AttitudeFilter) -> Iterator[Update]:
        """Give the filter the windows that need not wait any longer."""
        while self._pending and self._may_go(self._pending[0]):
            yield self._apply(attitude, self._pending.pop(0))

    def _may_go(self, window: Force) -> bool:
        assert self._newest is not None, "a window is made of samples"
        return self.motion.reaches(window.end) or not 0.0 <= self._newest - window.end < _WAIT_S

    def _apply(self, attitude: AttitudeFilter, window: Force) -> Update:
        known = self.motion.acceleration_ned(window.start, window.end)
        rotation = attitude.predicted(window.time).ned_from_body
        since_s = inf if self._last is None else abs(window.time - self._last)
        force, unknown_mps2 = window.mean_mps2, self._table.acceleration_sigma_mps2
        if known is not None and rotation is not None:
            force, unknown_mps2 = gravity_force(force, known[0], rotation), known[1]
        update = attitude.tilt(window.time, force, tilt_sigma_rad(self._table.force_sigma_mps2, unknown_mps2, since_s), PLUMB)
        self._last = window.time if update.used else self._last
        return update
