"""What an epoch loses, step by step, when a slow link cannot carry all of it, and when an epoch has to wait.

The steps, each on top of those before it: all signals; one signal per satellite and band; two bands per satellite; without SBAS;
without NavIC; without QZSS; without GLONASS. GPS, Galileo and BeiDou with two bands are always kept: when even they do not fit, epochs
are left out.
"""

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.signals import (
    ATTRIBUTES,
    BEIDOU,
    GALILEO,
    GLONASS,
    GPS,
    MAX_SIGNAL,
    NAVIC,
    QZSS,
    SATELLITES_PER_SYSTEM,
    SBAS,
    SYSTEMS,
)

ALL, ONE_PER_BAND, TWO_BANDS = range(3)
_DROPPED: Final = (SBAS, NAVIC, QZSS, GLONASS)
LAST_STEP: Final = TWO_BANDS + len(_DROPPED)

_ATTRIBUTE_ORDER: Final = "CLXQPWISDEABZMNYGHKRTUVFJO"  # of signals in one band the first of these is kept
_BAND_ORDER: Final = {GPS: "125", GLONASS: "12463", GALILEO: "17586", BEIDOU: "27651", QZSS: "1256", SBAS: "15", NAVIC: "591"}
_CALM_EPOCHS: Final = 30  # epochs with room to spare before a step is taken back
_LONGEST_WAIT_S: Final = 10.0  # a stream that was silent does not save up for more
_SLACK: Final = 1e-3  # time tags are not quite regular


def _ranks() -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the rank of an attribute, and that of a band by system and band: the lowest is kept first."""
    attributes = np.array([_ATTRIBUTE_ORDER.index(chr(ord("A") + k)) for k in range(ATTRIBUTES)])
    bands = np.full((len(SYSTEMS), MAX_SIGNAL // ATTRIBUTES), 9)
    for system, order in _BAND_ORDER.items():
        for rank, band in enumerate(order):
            bands[system, int(band)] = rank
    return attributes, bands


_ATTRIBUTE_RANK, _BAND_RANK = _ranks()


def thinned(epoch: Epoch, step: int) -> Epoch:
    """Return what is left of an epoch at a step, 0 to ``LAST_STEP``."""
    if step <= ALL or not len(epoch):
        return epoch
    bands = epoch.satellite.astype(np.int64) * 10 + epoch.signal // ATTRIBUTES
    epoch = epoch.take(_first_of_each(bands, _ATTRIBUTE_RANK[epoch.signal % ATTRIBUTES], 1))
    systems = epoch.satellite // SATELLITES_PER_SYSTEM
    if step >= TWO_BANDS:
        kept = _first_of_each(epoch.satellite.astype(np.int64), _BAND_RANK[systems, epoch.signal // ATTRIBUTES], 2)
        kept &= ~np.isin(systems, _DROPPED[: step - TWO_BANDS])
        epoch = epoch.take(kept)
    return epoch


def _first_of_each(group: NDArray[np.int64], rank: NDArray[np.int64], count: int) -> NDArray[np.bool_]:
    """Return which rows are among the ``count`` of the lowest rank in their group."""
    order = np.lexsort((rank, group))
    sorted_group = group[order]
    begins = np.searchsorted(sorted_group, sorted_group, side="left")
    kept = np.zeros(len(group), np.bool_)
    kept[order] = np.arange(len(group)) - begins < count
    return kept


class ByteBudget:
    """Decides per epoch how far it is thinned, or that it waits, so that the mean rate stays within ``bytes_per_second``.

    A step once taken is kept until what it takes away has fitted for a while: every change costs the rover signals.
    ``spare_bytes`` is what ephemerides may use. Nothing is limited with a rate of 0.
    """

    def __init__(self, bytes_per_second: float) -> None:
        self._rate = bytes_per_second
        self.step = 0
        self.spare_bytes = 0.0
        self.left_out = 0
        self._sent_s: float | None = None
        self._seen_s: float | None = None
        self._calm = 0

    def fit(self, epoch: Epoch, time_s: float, fixed_rate: float, encode: Callable[[Epoch], list[bytes]]) -> list[bytes]:
        """Return the frames of an epoch, thinned as needed, none if it is left out.

        ``fixed_rate``: bytes per second of the messages that are sent whatever comes. ``time_s`` rises from epoch to epoch.
        """
        if self._rate <= 0.0:
            return encode(epoch)
        rate = max(self._rate - fixed_rate, 0.0) * (1.0 + _SLACK)
        if self._seen_s is None or self._sent_s is None:
            self._seen_s = self._sent_s = time_s - 1.0
        period_s, waited_s = (min(max(time_s - before_s, 0.0), _LONGEST_WAIT_S) for before_s in (self._seen_s, self._sent_s))
        self._seen_s = time_s
        self._take_back(epoch, rate * period_s, encode)
        for step in range(self.step, LAST_STEP + 1):
            frames = encode(thinned(epoch, step))
            size = sum(map(len, frames))
            if size <= rate * waited_s:
                self.step, self._sent_s = step, time_s
                self.spare_bytes = min(self.spare_bytes + rate * waited_s - size, max(self._rate, 400.0))
                return frames
        self.left_out += 1
        self.step = LAST_STEP
        return []

    def _take_back(self, epoch: Epoch, allowance: float, encode: Callable[[Epoch], list[bytes]]) -> None:
        """Go back one step when it has fitted for some time."""
        if not self.step:
            return
        fits = sum(map(len, encode(thinned(epoch, self.step - 1)))) <= allowance
        self._calm = self._calm + 1 if fits else 0
        if self._calm >= _CALM_EPOCHS:
            self.step, self._calm = self.step - 1, 0
