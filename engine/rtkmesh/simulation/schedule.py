"""When a receiver hands out whose ephemeris: at its start, when a satellite is new, and again every frame."""

from math import floor
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.constants import SECONDS_PER_WEEK
from rtkmesh.gnss.signals import MAX_SATELLITE
from rtkmesh.gnss.time import GpsTime

FRAME_S: Final = 30.0
_WARM_S: Final = 2.0  # a warm receiver hands out everything within this time


class EphemerisSchedule:
    """Every satellite in view is due once in FRAME_S, each at its own offset; at a warm start also within the first two seconds."""

    def __init__(self, *, warm: bool) -> None:
        self._warm = warm
        self._start: GpsTime | None = None
        self._frames = np.full(MAX_SATELLITE, -1, np.int64)  # frame in which each was handed out last

    def due(self, satellites: NDArray[np.int16], time: GpsTime) -> list[int]:
        """Return which of the satellites in view are due at an epoch, in rising order."""
        if self._start is None:
            self._start = time
        return [satellite for satellite in np.unique(satellites).tolist() if self._is_due(satellite, time, self._start)]

    def _is_due(self, satellite: int, time: GpsTime, start: GpsTime) -> bool:
        """Say yes once per frame of the satellite's own counting, which begins at its offset."""
        offset_s = (satellite * 7 % 30) + (satellite % 5) * 0.2
        now_s = time.week * SECONDS_PER_WEEK + time.tow_s
        frame = floor((now_s - offset_s) / FRAME_S)
        since_s = time - start
        if self._frames[satellite] < 0:
            first_due_s = (satellite * 0.37) % _WARM_S if self._warm else (offset_s - (now_s - since_s)) % FRAME_S
            due = since_s >= first_due_s
        else:
            due = frame != self._frames[satellite]
        if due:
            self._frames[satellite] = frame
        return due
