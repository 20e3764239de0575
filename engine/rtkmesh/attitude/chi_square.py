"""The chi-square distribution for whole degrees of freedom, in closed form (Abramowitz and Stegun 26.4.4 and 26.4.5)."""

from functools import lru_cache
from math import erfc, exp, inf, nan, pi, sqrt
from typing import Final

_HALVINGS: Final = 200


def chi_square_tail(value: float, degrees: int) -> float:
    """Return the probability that chi-square with ``degrees`` of freedom exceeds ``value``; NaN without any."""
    if degrees < 1:
        return nan
    half, odd = 0.5 * max(value, 0.0), degrees % 2
    term, step = (2.0 * sqrt(half / pi), 1.5) if odd else (1.0, 1.0)
    total = 0.0
    for _ in range(degrees // 2):
        total += term
        term *= half / step
        step += 1.0
    return min(1.0, exp(-half) * total + (erfc(sqrt(half)) if odd else 0.0))


@lru_cache(maxsize=256)  # asked for in every epoch
def chi_square_limit(tail: float, degrees: int) -> float:
    """Return the value that chi-square exceeds with probability ``tail`` (in (0, 1)); infinite without freedom."""
    if degrees < 1:
        return inf
    low, high = 0.0, 1.0
    while chi_square_tail(high, degrees) > tail:
        low, high = high, 2.0 * high
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        if middle in (low, high):
            break
        low, high = (middle, high) if chi_square_tail(middle, degrees) > tail else (low, middle)
    return high
