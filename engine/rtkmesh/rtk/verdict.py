"""The integrity flag of a relative solution: which test failed, or why nothing can be promised."""

from collections.abc import Sequence
from math import isfinite, isnan, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.integrity import Integrity
from rtkmesh.rtk.integrity import FALSE_ALARM_SIGMAS, INFLATION
from rtkmesh.rtk.options import Mode, RtkOptions
from rtkmesh.rtk.solution import IntegrityReason, Status

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

_TESTS: Final = (IntegrityReason.RESIDUALS, IntegrityReason.FLOAT, IntegrityReason.CODES)
_PASSED: Final = (Integrity.OK, IntegrityReason.OK)  # members of enumerations are looked up once: each costs 0.1 us
_FIX: Final = Status.FIX


def verdict(
    status: Status, tests: Sequence[float], levels_m: tuple[float, float], x: Vector, P: Matrix, options: RtkOptions
) -> tuple[Integrity, IntegrityReason]:
    """Return the flag and its reason.

    ``tests`` are those of residuals, against the float solution and against the codes (above 1: failed; NaN: none); ``levels_m`` the
    protection levels; ``x`` and ``P`` begin with the baseline (m, ECEF) and its covariance.
    """
    if isnan(levels_m[0]):
        return Integrity.UNAVAILABLE, IntegrityReason.NOT_WATCHED
    if tests[0] > 1.0 or tests[1] > 1.0 or tests[2] > 1.0:
        return Integrity.FAILED, next(reason for reason, value in zip(_TESTS, tests, strict=True) if value > 1.0)
    if status is _FIX and length_fails(x, P, options):
        return Integrity.FAILED, IntegrityReason.LENGTH
    if not (isfinite(levels_m[0]) and isfinite(levels_m[1])):
        return Integrity.UNAVAILABLE, IntegrityReason.NO_REDUNDANCY
    limits = options.integrity
    if levels_m[0] > limits.alert_horizontal_m or levels_m[1] > limits.alert_vertical_m:
        return Integrity.UNAVAILABLE, IntegrityReason.ALERT_LIMIT
    return _PASSED


def length_fails(x: Vector, P: Matrix, options: RtkOptions) -> bool:
    """Return whether the baseline of a moving base is not as long as it is known to be."""
    if options.baseline_length_m is None or options.mode is not Mode.MOVING_BASE:
        return False
    length_m = sqrt(float(x[:3] @ x[:3]))
    variance = float(x[:3] @ P[:3, :3] @ x[:3]) / max(length_m**2, 1e-12) + options.baseline_sigma_m**2
    return abs(length_m - options.baseline_length_m) > FALSE_ALARM_SIGMAS * INFLATION * sqrt(variance)
