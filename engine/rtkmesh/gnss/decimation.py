"""Which epochs of a stream are taken where only some of them are wanted."""

from math import remainder
from typing import Final

from rtkmesh.gnss.constants import SECONDS_PER_WEEK
from rtkmesh.gnss.time import GpsTime

_TOLERANCE_S: Final = 0.005  # clocks of receivers that are not steered are some milliseconds off


class Decimator:
    """Takes the epochs at whole multiples of an interval, counted from the beginning of GPS time; with 0 all of them."""

    def __init__(self, interval_s: float) -> None:
        self._interval_s = interval_s
        self._turn: int | None = None

    def takes(self, time: GpsTime) -> bool:
        """Return whether an epoch of this time is taken; of those beside one multiple only the first is."""
        if self._interval_s <= 0.0:
            return True
        seconds = time.week * SECONDS_PER_WEEK + time.tow_s
        turn = round(seconds / self._interval_s)
        if abs(remainder(seconds, self._interval_s)) > _TOLERANCE_S or turn == self._turn:
            return False
        self._turn = turn
        return True
