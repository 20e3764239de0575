"""Slips of the phase by the lock times that receivers tell with their raw measurements."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel

SLIP_STATE: Final = 4  # numbers that are remembered of each signal
_LATE_MS: Final = 100.0  # the lock time may be of a moment before the epoch's


@kernel
def lock_slip(state: NDArray[np.float64], lock_ms: float, max_lock_ms: float, subtracted: int, phase_valid: bool, time_s: float) -> bool:
    """Return whether the phase slipped since this signal's last valid phase, and remember this epoch.

    ``state``: time of the last epoch (s, 0: none), its lock time (ms), whether the half cycle was subtracted in it, whether a
    slip waits to be told. The lock time fell or is shorter than the time since then (it counts to ``max_lock_ms``), or the subtraction of
    the half cycle changed. A slip that meets no valid phase waits for one.
    """
    slipped = lock_ms == 0
    if state[0] > 0.0:
        too_short = lock_ms < max_lock_ms and lock_ms + _LATE_MS < (time_s - state[0]) * 1e3
        slipped = slipped or lock_ms < state[1] or too_short or subtracted != state[2] or state[3] > 0.0
    state[0], state[1], state[2] = time_s, lock_ms, subtracted
    state[3] = 1.0 if slipped and not phase_valid else 0.0
    return slipped
