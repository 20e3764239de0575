"""A receiver's recording as it would have been made had time run the other way.

Observations stay what they are; what a receiver says of *the time before* them turns round. A slip between epochs k-1 and k is flagged at
k; going backward it belongs to the step from k to k-1 and is flagged there. A lock time counts from the beginning of an arc; going backward
it counts from its end. Gaps need nothing: the times of the epochs say them.
"""

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.epoch import HALF_CYCLE, SLIP, Epoch
from rtkmesh.gnss.signals import MAX_SATELLITE, SIGNALS_PER_SATELLITE
from rtkmesh.gnss.time import GpsTime

Vector = NDArray[np.float64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.int64]

_LAST_S: Final = 1e-3  # a phase was tracked for a moment beyond its last epoch: an arc that ends behind a gap is longer than the gap


class Reversal:
    """Turns the epochs of one receiver round. Mutable: epochs come one after the other against the order of their recording.

    An arc goes on over a step of ``elapsed`` seconds where neither a flag nor the lock times speak against it (``slips.lost_lock``), and
    over epochs without a usable phase where its lock time is longer than the gap. Turning twice gives the first recording with lock times
    that count from the first epoch at most, and with flags at all breaks that the lock times had told.
    """

    def __init__(self) -> None:
        count = MAX_SATELLITE * SIGNALS_PER_SATELLITE
        # Of the last epoch that was turned with a usable phase of a signal, which is the next one on the recording's own clock.
        self._at_s: Vector = np.full(count, np.nan)
        self._lock_s: Vector = np.full(count, np.nan)
        self._left_s: Vector = np.full(count, np.nan)
        self._number: Indices = np.full(count, -1)
        self._slipped: Mask = np.zeros(count, np.bool_)  # flagged there, or at an epoch without a usable phase since
        self._first: GpsTime | None = None
        self._turned = 0

    def turn(self, epoch: Epoch) -> Epoch:
        """Return the epoch with the slip flags and lock times (s) of a receiver on whose clock it follows the one that was turned last."""
        self._first = self._first or epoch.time
        now_s, key = epoch.time - self._first, epoch.satellite.astype(np.int64) * SIGNALS_PER_SATELLITE + epoch.signal
        elapsed_s = np.abs(self._at_s[key] - now_s)
        broken = self._broken(key, epoch.lock_s, elapsed_s)
        left_s = np.where(broken | np.isnan(elapsed_s), _LAST_S, self._left_s[key] + elapsed_s)
        left_s[np.isnan(epoch.lock_s)] = np.nan
        flags = (epoch.flags & ~np.uint8(SLIP)) | np.where(broken, np.uint8(SLIP), np.uint8(0))
        self._remember(epoch, key, now_s, left_s)
        return replace(epoch, flags=flags, lock_s=left_s)

    def _broken(self, key: Indices, lock_s: Vector, elapsed_s: Vector) -> Mask:
        """Return which arcs end at this epoch, by what the receiver said at the next one that it recorded."""
        next_lock_s, over_gap = self._lock_s[key], self._number[key] != self._turned - 1
        lost = ((next_lock_s < lock_s - 1e-3) | (2.0 * next_lock_s + 0.5 < elapsed_s)) & np.isfinite(lock_s)
        return (self._slipped[key] | lost | (over_gap & (next_lock_s <= elapsed_s))) & ~np.isnan(elapsed_s)

    def _remember(self, epoch: Epoch, key: Indices, now_s: float, left_s: Vector) -> None:
        flagged = epoch.flags & SLIP != 0
        usable = np.isfinite(epoch.phase_cyc) & (epoch.flags & HALF_CYCLE == 0)
        self._slipped[key] = np.where(usable, flagged, self._slipped[key] | flagged)
        seen = key[usable]
        self._at_s[seen], self._lock_s[seen], self._left_s[seen] = now_s, epoch.lock_s[usable], left_s[usable]
        self._number[seen] = self._turned
        self._turned += 1
