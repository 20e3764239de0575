"""Confidence bounds of shares (Clopper and Pearson 1934), without SciPy."""

from math import exp, lgamma, log, log1p


def clopper_pearson(hits: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return the exact bounds of the probability of what happened in ``hits`` of ``trials`` independent trials; (0, 1) of no trial."""
    if trials == 0:
        return 0.0, 1.0
    tail = (1.0 - confidence) / 2.0
    low = 0.0 if hits == 0 else _quantile(hits, trials - hits + 1, tail)
    high = 1.0 if hits == trials else _quantile(hits + 1, trials - hits, 1.0 - tail)
    return low, high


def _quantile(a: float, b: float, probability: float) -> float:
    """Return the quantile of a beta distribution, by bisection."""
    low, high = 0.0, 1.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        if incomplete_beta(a, b, middle) < probability:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


def incomplete_beta(a: float, b: float, x: float) -> float:
    """Return the regularised incomplete beta function I_x(a, b) (DLMF 8.17.22, on the side where the fraction converges fast)."""
    if x <= 0.0 or x >= 1.0:
        return float(x >= 1.0)
    if x > (a + 1.0) / (a + b + 2.0):
        return 1.0 - incomplete_beta(b, a, 1.0 - x)
    front = exp(lgamma(a + b) - lgamma(a) - lgamma(b) + a * log(x) + b * log1p(-x)) / a
    return front / _fraction(a, b, x)


def _fraction(a: float, b: float, x: float) -> float:
    """Return the continued fraction 1 + d1 / (1 + d2 / (1 + ...)) of DLMF 8.17.22, evaluated backwards from far enough."""
    value = 1.0
    for m in range(400, 0, -1):
        half, odd = divmod(m, 2)
        if odd:
            term = -(a + half) * (a + b + half) * x / ((a + 2.0 * half) * (a + 2.0 * half + 1.0))
        else:
            term = half * (b - half) * x / ((a + 2.0 * half - 1.0) * (a + 2.0 * half))
        value = 1.0 + term / value
    return value
