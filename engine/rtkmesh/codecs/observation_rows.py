"""Rows of observations, one per satellite and signal, in the order in which they come, and how they are put in the order of an epoch."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.gnss.signals import MAX_SATELLITE

MAX_MESSAGE_ROWS: Final = 64  # an RTCM 3 message holds at most this many (10403.3, 3.5.1 and 3.5.16.1)
_FIRST_CAPACITY: Final = 512

_ROW_BITS, _PRIORITY_BITS, _SIGNAL_BITS = 32, 1, 9
_SIGNAL_SHIFT: Final = _ROW_BITS + _PRIORITY_BITS
_SATELLITE_SHIFT: Final = _SIGNAL_SHIFT + _SIGNAL_BITS
_ROW_MASK: Final = (1 << _ROW_BITS) - 1

CellRows = NDArray[np.int16]  # by row: satellite, signal, channel, flags, priority (of equal signals the lowest counts)
ValueRows = NDArray[np.float64]  # by row: pseudorange_m, phase_cyc, doppler_hz, cn0_dbhz, lock_s


class Rows:
    """The rows from ``begin`` to ``end`` are in use; behind them ``reserve`` makes room for those of one more message."""

    def __init__(self) -> None:
        self.cells: CellRows = np.empty((_FIRST_CAPACITY, 5), np.int16)
        self.values: ValueRows = np.empty((_FIRST_CAPACITY, 5))
        self.begin = self.end = 0

    def reserve(self) -> int:
        """Make room for one message and return the number of its first row."""
        if self.begin == self.end:
            self.begin = self.end = 0
        elif self.end + MAX_MESSAGE_ROWS > len(self.cells):
            self._move(2 * len(self.cells) if 2 * (self.end - self.begin) > len(self.cells) else len(self.cells))
        return self.end

    def _move(self, capacity: int) -> None:
        """Bring the rows in use to the beginning of new arrays."""
        count = self.end - self.begin
        cells, values = np.empty((capacity, 5), np.int16), np.empty((capacity, 5))
        cells[:count], values[:count] = self.cells[self.begin : self.end], self.values[self.begin : self.end]
        self.cells, self.values, self.begin, self.end = cells, values, 0, count


@kernel
def row_key(satellite: int, signal: int, priority: int, row: int) -> int:
    """Return a number that rises with satellite, signal, priority (0 or 1) and row, in this order."""
    return ((satellite << _SIGNAL_BITS | signal) << _PRIORITY_BITS | priority) << _ROW_BITS | row


@kernel
def key_parts(key: int) -> tuple[int, int, int]:
    """Return satellite, signal and row of a key."""
    return key >> _SATELLITE_SHIFT, key >> _SIGNAL_SHIFT & (1 << _SIGNAL_BITS) - 1, key & _ROW_MASK


@kernel
def sort_keys(keys: NDArray[np.int64]) -> int:
    """Sort the keys; of equal satellite and signal only the lowest stays. Returns the number of keys, which then stand in front."""
    rising = True
    for i in range(1, len(keys)):
        rising = rising and keys[i - 1] < keys[i]
    if not rising:
        place, before, unsorted = np.zeros(MAX_SATELLITE, np.int64), 0, keys.copy()
        for key in keys:
            place[key >> _SATELLITE_SHIFT] += 1
        for satellite in range(MAX_SATELLITE):
            before, place[satellite] = before + place[satellite], before
        for key in unsorted:
            keys[place[key >> _SATELLITE_SHIFT]] = key
            place[key >> _SATELLITE_SHIFT] += 1
        for i in range(1, len(keys)):  # by insertion what is left to do: the signals of each satellite
            key, k = keys[i], i
            while k > 0 and keys[k - 1] > key:
                keys[k] = keys[k - 1]
                k -= 1
            keys[k] = key
    count = 0
    for i in range(len(keys)):
        if count == 0 or keys[i] >> _SIGNAL_SHIFT != keys[count - 1] >> _SIGNAL_SHIFT:
            keys[count] = keys[i]
            count += 1
    return count
