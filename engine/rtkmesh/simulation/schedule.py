"""When a receiver hands out whose ephemeris: at a warm start, once a new satellite has been heard for a while, and again every frame."""

from math import floor
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.constants import SECONDS_PER_WEEK
from rtkmesh.gnss.signals import MAX_SATELLITE
from rtkmesh.gnss.time import GpsTime

FRAME_S: Final = 30.0
_WARM_S: Final = 1.9  # a warm receiver hands out everything within this time
_SHORTEST_S: Final = 18.0  # it takes three subframes to hear an ephemeris, at best


class EphemerisSchedule:
    """Every satellite in view is due once in FRAME_S; a new one 18 to 30 s after it came into view, at a warm start within two seconds."""

    def __init__(self, *, warm: bool) -> None:
        self._warm = warm
        self._start_s = np.nan
        self._first_due_s = np.full(MAX_SATELLITE, np.nan)  # since 1980
        self._frames = np.full(MAX_SATELLITE, -1, np.int64)  # frame, of each satellite's own counting, handed out last

    def due(self, satellites: NDArray[np.int16], time: GpsTime) -> list[int]:
        """Return which of the satellites in view are due at an epoch, in rising order."""
        now_s = time.week * SECONDS_PER_WEEK + time.tow_s
        if np.isnan(self._start_s):
            self._start_s = now_s
        return [satellite for satellite in np.unique(satellites).tolist() if self._is_due(satellite, now_s)]

    def _is_due(self, satellite: int, now_s: float) -> bool:
        """Say yes when it is due for the first time, then once per frame."""
        share = satellite * 0.37 % 1.0
        if np.isnan(self._first_due_s[satellite]):
            at_start = self._warm and now_s - self._start_s < _WARM_S
            self._first_due_s[satellite] = now_s + (share * _WARM_S if at_start else _SHORTEST_S + share * (FRAME_S - _SHORTEST_S))
        frame = floor((now_s - self._first_due_s[satellite]) / FRAME_S)
        due = frame > self._frames[satellite]
        if due:
            self._frames[satellite] = frame
        return bool(due)
