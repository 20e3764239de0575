"""How sure one integer vector is against another: odds from the squared norms of both, and what they are worth."""

from math import log
from typing import Final

from rtkmesh._jit import kernel_in_place

PRIOR_DOF: Final = 4.0  # how well the variance level is known before the norms are seen: see log_odds
NORM_LIMIT: Final = 8.0  # squared norm per ambiguity that honest float solutions do not exceed

# The probability of wrong integers is exp(-odds / c): benchmarks/integrity.py shows how it was calibrated.
SURENESS: Final = 1.5  # c at the base: log odds are too sure by this


@kernel_in_place
def log_odds(best: float, other: float, count: int) -> float:
    """Return the natural logarithm of the odds of the best integer vector (squared norm ``best``) against another.

    Float ambiguities that are normal around the truth with a covariance known up to a factor, the factor inverse chi-square with
    PRIOR_DOF degrees of freedom around 1, are Student-t (Zellner 1971, B.2.4): p ~ (PRIOR_DOF + norm)^-((PRIOR_DOF + n) / 2). For few
    ambiguities this asks for a large ratio of the norms, for many for a small one, and a norm that is too large for its count costs
    confidence.
    """
    return 0.5 * (PRIOR_DOF + count) * log((PRIOR_DOF + other) / (PRIOR_DOF + best))
