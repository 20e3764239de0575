"""Which fixes are shown when the free search of their epoch does not give the integers that they hold, or hardly does.

Right integers outlive weak epochs, so that alone is no doubt. But what is wrong of fixes in streets is mostly among these: integers that
a search gave once and never again, held ones that come back after a while of slips that nobody told, phases that arrive by a reflection.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel_in_place
from rtkmesh.rtk.asked_odds import MIRRORED_CODES, WEAK_COUNT, are_worse
from rtkmesh.rtk.memory import AGREED_S, CONFIRMED, HELD_SINCE_S, LAST_FIX_S, LONE_S, MISSED, NOTED_S, PROVEN_S, SINCE_SEARCH, UNAGREED

Vector = NDArray[np.float64]

# In simulated streets (180 runs, 151 wrong of 14953 fixes) these four hide 75 wrong ones and 2.2 % of the right ones; of the recordings'
# one fix of umea_r001 and none else.
AGREED_LEAST_S: Final = 2.9  # for so long searches have given the same integers before: three epochs of a second
MISSED_MOST: Final = 2.0  # epochs without a fix, and
MISSED_S: Final = 3.0  # this long, after which a search must agree again
DEPARTURE_ALONE: Final = 2.0  # squared departure from the prediction, where others may have ``validation.DEPARTURE_LIMIT``
# Wrong integers that one search gave clearly are seldom given clearly again. So few ones must be, with PROOF_ODDS for PROVEN_LEAST_S since
# they are held or came back, where codes are worse than MIRRORED_CODES. Until then no fix is shown that its
# epoch's search does not give with FAINT_ODDS. In simulated streets (2640 runs of two seeds) this finds 250 of 816 wrong fixes, most of
# the integers that are metres off for long among them, and 2.0 % of the right ones; on recordings none.
FEW_INTEGERS: Final = 10
PROOF_ODDS: Final = 3.0
PROVEN_LEAST_S: Final = 4.9
FAINT_ODDS: Final = 1.0
# In streets integers that are few (``asked_odds.WEAK_COUNT``) and that no search has given for so long must fit as what joins there must,
# by this squared norm each. In 180 simulated runs this hides 9 of 37 wrong fixes, 8 of one run, and 0.2 % of the right ones.
LONE_LEAST_S: Final = 2.9
LONE_FIT: Final = 4.0
AT_MOST_S: Final = 1.0  # an epoch counts for no longer, however long ago the last one was


@kernel_in_place
def stands_alone(memory: Vector, away: float, time_s: float, unsafe: bool, odds: float) -> bool:
    """Return whether a fix is not to be shown before a search agrees with it; ``away`` is its squared departure from the prediction,
    ``odds`` the log odds of the epoch's free search; ``unsafe``: its integers must be proven.
    """
    if memory[SINCE_SEARCH] > 1.0:  # large sets that are sure are not searched in every epoch
        return False
    unproven = unsafe and memory[PROVEN_S] < PROVEN_LEAST_S and memory[HELD_SINCE_S] < time_s
    if memory[UNAGREED] == 0.0:
        return bool(unproven and odds < FAINT_ODDS)
    return bool(unproven or memory[AGREED_S] < AGREED_LEAST_S or _is_missing(memory, time_s) or away > DEPARTURE_ALONE)


@kernel_in_place
def is_left_alone(memory: Vector, integers: int, misfit: float) -> bool:
    """Return whether few integers, with this squared norm each, fit badly and no search has given them for a while."""
    if memory[SINCE_SEARCH] > 1.0 or integers >= WEAK_COUNT:
        return False
    return bool(memory[LONE_S] >= LONE_LEAST_S and misfit > LONE_FIT)


@kernel_in_place
def is_unsafe(integers: int, level: float) -> bool:
    """Return whether integers are so few, with codes of this variance factor (infinite: not known), that they must be proven."""
    return integers <= FEW_INTEGERS and are_worse(level, MIRRORED_CODES)


@kernel_in_place
def note_proof(memory: Vector, confirmed: float, odds: float, time_s: float) -> None:
    """Count for how long searches have given what is held; ``confirmed`` is how many had before this epoch, ``odds`` the log odds of its
    search.
    """
    step_s = min(time_s - memory[NOTED_S], AT_MOST_S)
    memory[NOTED_S] = time_s
    if memory[HELD_SINCE_S] == time_s:
        memory[AGREED_S], memory[PROVEN_S], memory[LONE_S] = 0.0, 0.0, 0.0
    elif memory[CONFIRMED] > confirmed:
        memory[AGREED_S] += step_s
        memory[PROVEN_S] += step_s if odds >= PROOF_ODDS else 0.0
        memory[LONE_S] = 0.0
    else:
        memory[LONE_S] += step_s


@kernel_in_place
def note_fix(memory: Vector, fixed: bool, time_s: float) -> None:
    """Remember when there was a fix, and count the epochs without one; what was proven is forgotten while there is none."""
    memory[MISSED] = 0.0 if fixed else memory[MISSED] + 1.0
    if fixed:
        memory[LAST_FIX_S] = time_s
    elif _is_missing(memory, time_s):
        memory[PROVEN_S] = 0.0


@kernel_in_place
def _is_missing(memory: Vector, time_s: float) -> bool:
    """Return whether there has been no fix for so long that what comes back is not what was lost."""
    return bool(memory[MISSED] > MISSED_MOST and time_s - memory[LAST_FIX_S] > MISSED_S)
