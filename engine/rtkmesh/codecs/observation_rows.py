"""Rows of observations, one per satellite and signal, in the order in which they come, and how they are put in the order of an epoch."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.gnss.signals import MAX_SATELLITE

MAX_MESSAGE_ROWS: Final = 64  # an RTCM 3 message holds at most this many (10403.3, 3.5.1 and 3.5.16.1)
_FIRST_CAPACITY: Final = 512

PRIORITY_SHIFT: Final = 32
SIGNAL_SHIFT: Final = PRIORITY_SHIFT + 1
SATELLITE_SHIFT: Final = SIGNAL_SHIFT + 9
SIGNAL_MASK, ROW_MASK = (1 << SATELLITE_SHIFT - SIGNAL_SHIFT) - 1, (1 << PRIORITY_SHIFT) - 1

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
def sort_keys(keys: NDArray[np.int64]) -> int:
    """Sort the keys; of equal satellite and signal only the lowest stays. Returns the number of keys, which then stand in front.

    A key is ``satellite << SATELLITE_SHIFT | signal << SIGNAL_SHIFT | priority (0 or 1) << PRIORITY_SHIFT | row``.
    """
    rising, total = True, len(keys)
    for i in range(1, total):
        rising = rising and keys[i - 1] < keys[i]
    if not rising:
        place, before, unsorted = np.empty(MAX_SATELLITE, np.int64), 0, np.empty(total, np.int64)
        for satellite in range(MAX_SATELLITE):
            place[satellite] = 0
        for i in range(total):
            unsorted[i] = keys[i]
            place[keys[i] >> SATELLITE_SHIFT] += 1
        for satellite in range(MAX_SATELLITE):
            rows = place[satellite]
            place[satellite] = before
            before += rows
        for i in range(total):
            satellite = unsorted[i] >> SATELLITE_SHIFT
            keys[place[satellite]] = unsorted[i]
            place[satellite] += 1
        for i in range(1, total):  # by insertion what is left to do: the signals of each satellite
            key, k = keys[i], i
            while k > 0 and keys[k - 1] > key:
                keys[k] = keys[k - 1]
                k -= 1
            keys[k] = key
    count = 0
    for i in range(total):
        if count == 0 or keys[i] >> SIGNAL_SHIFT != keys[count - 1] >> SIGNAL_SHIFT:
            keys[count] = keys[i]
            count += 1
    return count
