"""A filter that begins anew by itself: by how much that moves the position, so that nobody takes the jump for a motion."""

from dataclasses import dataclass
from math import isfinite
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.frames import enu_from_ecef_at
from rtkmesh.rtk.options import SlipOptions
from rtkmesh.rtk.solution import Solution, Status

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

_GAP_S: Final = SlipOptions().maximum_gap_s  # no ambiguity outlives a longer one: that a filter begins anew behind it is no fault
_EXPLAINED_SIGMAS: Final = 4.0  # a float that is left for a fix jumps by what its own sigmas allow
_RELATIVE: Final = (Status.FIX, Status.FLOAT, Status.DGPS)


@dataclass(frozen=True, slots=True, eq=False)
class Beginning:
    """What a new beginning of the filter did: the jump (east, north, up, m) from where the last solution and its velocity led, its sigmas
    (NaN where one of both is not known), how old the last solution is (s), and the status of both.
    """

    enu_m: Vector
    sigma_enu_m: Vector
    gap_s: float
    old: Status
    new: Status

    @property
    def text(self) -> str:
        """For people."""
        if not isfinite(self.enu_m[0]):
            return f"the filter began anew: {self.old.name}, then {self.new.name} after {self.gap_s:.1f} s"
        east, north, up = self.enu_m.tolist()
        how = f"the position jumps by {east:+.3f} E {north:+.3f} N {up:+.3f} U m"
        return f"the filter began anew: {how} ({self.old.name}, then {self.new.name} after {self.gap_s:.1f} s)"

    @property
    def is_alarming(self) -> bool:
        """Whether it is more than what a long gap, or a float that gives way to a clear fix within its sigmas, explains."""
        explained = self.old is not Status.FIX and bool((np.abs(self.enu_m) <= _EXPLAINED_SIGMAS * self.sigma_enu_m).all())
        return self.gap_s <= _GAP_S and not explained

    @property
    def data(self) -> dict[str, Any]:
        """For programs."""
        return {
            "jump_enu_m": _finite(self.enu_m),
            "sigma_enu_m": _finite(self.sigma_enu_m),
            "gap_s": self.gap_s,
            "old_solution": self.old.name,
            "new_solution": self.new.name,
        }


class Beginnings:
    """Watches the solutions of one engine. Mutable."""

    def __init__(self) -> None:
        self._count = 0
        self._last: Solution | None = None

    def solved(self, solution: Solution, *, moving_base: bool) -> Beginning | None:
        """Return what a new beginning did, with the first solution that has a place after it; None where there was none.

        Of a ``moving_base`` the jump is the baseline's: its absolute position is as noisy as codes are.
        """
        last, begun = self._last, solution.resets > self._count
        if not np.isfinite(solution.position_ecef_m).all():
            return None
        if solution.status in _RELATIVE:
            self._last = solution
        if not begun:
            return None
        self._count = solution.resets
        return None if last is None else _between(last, solution, moving_base=moving_base)


def _between(last: Solution, solution: Solution, *, moving_base: bool) -> Beginning:
    gap_s = abs(solution.time - last.time)
    if moving_base:
        jump_m = solution.baseline_ecef_m - last.baseline_ecef_m
        covariance_m2 = solution.baseline_cov_ecef_m2 + last.baseline_cov_ecef_m2
    else:
        expected_ecef_m, sure_m2 = _moved_on(last, gap_s)
        jump_m, covariance_m2 = solution.position_ecef_m - expected_ecef_m, solution.position_cov_ecef_m2 + sure_m2
    turn = enu_from_ecef_at(solution.position_ecef_m)
    variances_m2 = np.diag(turn @ covariance_m2 @ turn.T)
    return Beginning(turn @ jump_m, np.sqrt(np.maximum(variances_m2, 0.0)), gap_s, last.status, solution.status)


def _moved_on(last: Solution, gap_s: float) -> tuple[Vector, Matrix]:
    """Return where a solution and its velocity lead, with covariance (ECEF); where it was, if it has no velocity (``static``)."""
    if not np.isfinite(last.velocity_ecef_mps).all():
        return last.position_ecef_m, last.position_cov_ecef_m2
    return last.position_ecef_m + gap_s * last.velocity_ecef_mps, last.position_cov_ecef_m2 + gap_s**2 * last.velocity_cov_ecef_m2ps2


def _finite(vector: Vector) -> list[float] | None:
    return vector.tolist() if np.isfinite(vector).all() else None
