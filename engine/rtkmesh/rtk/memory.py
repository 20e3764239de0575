"""What ambiguity resolution remembers of one filter, and its options, as kernels take them.

Thresholds that several of its steps share are here; they are log odds (see ``models.odds``), so they adapt to the strength of the
model.
"""

from math import inf, log, nan
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel_in_place
from rtkmesh.models.odds import PRIOR_DOF
from rtkmesh.rtk.options import AmbiguityMode, AmbiguityOptions
from rtkmesh.rtk.state import INTEGER, Filter

Vector = NDArray[np.float64]

ACCEPT_AT_ONCE: Final = 7.0  # log odds for a fix from one search: of 4400 searches above 5.5 on recordings none was wrong
ACCEPT_AFTER_STREAK: Final = 5.0  # log odds for a fix from a row of searches with equal results
STREAK_S: Final = 10.0
STREAK_EPOCHS_LEAST: Final = 5
SLOPE_SIGMA_M: Final = 0.03  # per channel between makes (Wanninger 2012, J. Geodesy 86:139-148: up to 25 mm on L1)

# What is remembered of one filter from epoch to epoch, in the memory of ``resolve``. SLOPE_* and SLOPE_SIGMA_* (m) are those of GLONASS
# phase biases per channel on G1 and G2 (``slopes``); LAST_* are numbers of the last free search; UNAGREED counts epochs since one gave
# what is held (``integrity``), MISSED those since the last fix, at LAST_FIX_S (``agreement``), FIX_SIGMA is the sigma of that in 3D (m);
# AGREED_S and PROVEN_S say for how long searches have given what is held, and have done so clearly, LONE_S since when none has, as of
# NOTED_S (``agreement``); SHARE is for how much the epoch counts (``predicted``); OBJECTED whether all satellites but one gave others
# (``objections``); truth values are 0.0 and 1.0.
(
    STREAK_START_S, STREAK_EPOCHS, DOUBTS, HELD_SINCE_S, CONFIRMED, SHOWN, SINCE_SEARCH, TRUSTS_GLONASS, GLONASS_VOTES, SLOPE_G1, SLOPE_G2,
    SLOPE_SIGMA_G1, SLOPE_SIGMA_G2, LAST_COUNT, LAST_NORM, LAST_SECOND, LAST_SUCCESS, LAST_ODDS, INFORMED, UNAGREED, LAST_FIX_S, MISSED,
    FIX_SIGMA, AGREED_S, PROVEN_S, NOTED_S, SHARE, OBJECTED,
    LONE_S,
) = range(29)  # fmt: skip
MEMORY: Final = 29
_OF_INTEGERS: Final = np.ones(MEMORY, np.bool_)
_OF_INTEGERS[[TRUSTS_GLONASS, SLOPE_G1, SLOPE_G2, SLOPE_SIGMA_G1, SLOPE_SIGMA_G2]] = False
_NOTHING: Final = np.zeros(MEMORY)
_NOTHING[[STREAK_START_S, HELD_SINCE_S, LAST_FIX_S]] = inf
_NOTHING[[LAST_COUNT, NOTED_S, SHARE]] = -1.0, -inf, 1.0


class ResolveSetup(NamedTuple):
    """Options of ambiguity resolution for kernels; ``confidence`` is the factor on log odds, ``length_m`` NaN where it is not known.

    With ``hold_after`` >= 0 the filter is told of integers that as many searches have confirmed, with this variance (cycles squared).
    """

    confidence: float
    minimum_ambiguities: int
    length_m: float
    length_sigma_m: float
    hold_variance_cyc2: float
    hold_after: int


def resolve_setup(options: AmbiguityOptions, length_m: float | None, length_sigma_m: float) -> ResolveSetup:
    """Return the options for kernels; ``length_m`` is the known length of the baseline."""
    after = options.hold_after_epochs if options.mode is AmbiguityMode.FIX_AND_HOLD else -1
    return ResolveSetup(
        confidence(options.ratio), options.minimum_ambiguities, nan if length_m is None else length_m, length_sigma_m,
        options.hold_variance_cyc2, after,
    )  # fmt: skip


def new_memory() -> Vector:
    """Return the memory of a filter that has resolved nothing."""
    memory = np.zeros(MEMORY)
    memory[[SLOPE_SIGMA_G1, SLOPE_SIGMA_G2]] = SLOPE_SIGMA_M
    forget(memory)
    return memory


def forget(memory: Vector) -> None:
    """Forget the integers; what was learned of GLONASS belongs to the receivers and stays."""
    np.copyto(memory, _NOTHING, where=_OF_INTEGERS)


@kernel_in_place
def release(f: Filter) -> None:
    """Hold no integers."""
    f.history[:, INTEGER] = np.nan


def confidence(ratio: float) -> float:
    """Return the factor on log odds that a ratio asks for: 1 at 3, by the odds of that ratio for ten honest ambiguities."""
    return log((PRIOR_DOF + 10.0 * max(ratio, 1.05)) / (PRIOR_DOF + 10.0)) / log((PRIOR_DOF + 30.0) / (PRIOR_DOF + 10.0))
