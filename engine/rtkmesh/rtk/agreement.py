"""Which fixes are shown when the free search of their epoch does not give the integers that they hold.

Right integers outlive weak epochs, so that alone is no doubt. But what is wrong of fixes in streets is mostly among these: integers that
a search gave once and never again, held ones that come back after a while of slips that nobody told, phases that arrive by a reflection.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel_in_place
from rtkmesh.rtk.memory import CONFIRMED, LAST_FIX_S, MISSED, SINCE_SEARCH, UNAGREED

Vector = NDArray[np.float64]

# In simulated streets (180 runs, 151 wrong of 14953 fixes) the three hide 75 wrong ones and 2.2 % of the right ones; of the recordings'
# one fix of umea_r001 and none else.
CONFIRMED_LEAST: Final = 3.0  # searches that have given the same integers before
MISSED_MOST: Final = 2.0  # epochs without a fix, and
MISSED_S: Final = 3.0  # this long, after which a search must agree again
DEPARTURE_ALONE: Final = 2.0  # squared departure from the prediction, where others may have ``validation.DEPARTURE_LIMIT``


@kernel_in_place
def stands_alone(memory: Vector, away: float, time_s: float) -> bool:
    """Return whether a fix is not to be shown before a search agrees with it; ``away`` is its squared departure from the prediction."""
    if memory[UNAGREED] == 0.0 or memory[SINCE_SEARCH] > 1.0:  # large sets that are sure are not searched in every epoch
        return False
    returns = memory[MISSED] > MISSED_MOST and time_s - memory[LAST_FIX_S] > MISSED_S
    return bool(memory[CONFIRMED] < CONFIRMED_LEAST or returns or away > DEPARTURE_ALONE)


@kernel_in_place
def note_fix(memory: Vector, fixed: bool, time_s: float) -> None:
    """Remember when there was a fix, and count the epochs without one."""
    memory[MISSED] = 0.0 if fixed else memory[MISSED] + 1.0
    if fixed:
        memory[LAST_FIX_S] = time_s
