"""Which options a filter can go on under, and what becomes of its states then."""

from dataclasses import dataclass
from math import sqrt
from typing import Final

import numpy as np

from rtkmesh.rtk.bookkeeping import seed
from rtkmesh.rtk.options import AmbiguityMode, Mode, RtkOptions
from rtkmesh.rtk.state import DYNAMIC, INTEGER, SEED_FIXED, SEED_STANDING, Filter, FilterState, length_m, trace

_WITH_PHASES: Final = frozenset({Mode.STATIC, Mode.STATIC_START, Mode.KINEMATIC, Mode.FIXED, Mode.MOVING_BASE})
_REMEMBERS: Final = (AmbiguityMode.CONTINUOUS, AmbiguityMode.FIX_AND_HOLD)
_PARTS: Final = ("position", "velocity", "ambiguities", "integers")
_NEAR_SIGMAS: Final = 5.0
_NEAR_M: Final = 0.1


@dataclass(frozen=True, slots=True)
class Continuation:
    """Whether a filter goes on under other options. ``obstacle`` says why not, and then nothing was changed; else which of its states
    were ``kept``, and which begin ``anew``.
    """

    obstacle: str = ""
    kept: tuple[str, ...] = ()
    anew: tuple[str, ...] = ()


def obstacle(now: RtkOptions, new: RtkOptions, state: FilterState | None) -> str:
    """Return why a filter cannot go on under new options; nothing when it can."""
    if now.mode is not new.mode and not {now.mode, new.mode} <= _WITH_PHASES:
        return f"modes {now.mode} and {new.mode} have different states"
    if new.mode is Mode.MOVING_BASE is now.mode and _length(now) != _length(new):
        return "integers were found with another baseline length"
    if now.ambiguity.mode is AmbiguityMode.FIX_AND_HOLD and new.ambiguity.mode is not AmbiguityMode.FIX_AND_HOLD:
        return "the filter was told integers, which it cannot forget"
    if new.mode is Mode.FIXED and now.mode is Mode.FIXED and now.fixed_position_ecef_m != new.fixed_position_ecef_m:
        return "the filter was told another position"
    if new.mode is Mode.FIXED and now.mode is not Mode.FIXED and state is not None:
        return _too_far(state, new)
    return ""


def _length(options: RtkOptions) -> tuple[float | None, float]:
    return options.baseline_length_m, options.baseline_sigma_m


def _too_far(state: FilterState, new: RtkOptions) -> str:
    """Return why ambiguities that belong to the present position cannot stay with the fixed one; nothing when they can."""
    gap_m = length_m(np.array(new.fixed_position_ecef_m) - state.rover_ecef_m)
    if gap_m <= _NEAR_M + _NEAR_SIGMAS * sqrt(trace(state.filter.P)):
        return ""
    return f"the fixed position is {gap_m:.2f} m from where the filter is"


def keeps_integers(now: RtkOptions, new: RtkOptions) -> bool:
    """Return whether integers that are held stay so."""
    return now.ambiguity.mode is new.ambiguity.mode or {now.ambiguity.mode, new.ambiguity.mode} <= set(_REMEMBERS)


def carry_on(state: FilterState, before: RtkOptions, options: RtkOptions, *, moved: bool, moves: bool) -> Continuation:
    """Let a state be what it is under other options; return what was kept. ``moved`` and ``moves``: whether the rover did and does.

    What begins to move gets its velocity in the filter's next step.
    """
    anew: list[str] = []
    if options.mode is Mode.FIXED is not before.mode:
        anew.append("position")
        for one in (state.filter, state.informed):
            seed(one, np.array(options.fixed_position_ecef_m) - state.base_ecef_m, SEED_FIXED)
    elif moved and not moves:
        _stand(state.filter)
        _stand(state.informed)
    if moved is not moves:
        anew.append("velocity")
    if not keeps_integers(before, options):
        anew.append("integers")
        state.filter.history[:, INTEGER] = state.informed.history[:, INTEGER] = np.nan
    return Continuation("", tuple(name for name in _PARTS if name not in anew), tuple(anew))


def _stand(f: Filter) -> None:
    """Take velocity and acceleration for zero; all else stays."""
    for i in range(3, DYNAMIC):
        f.P[i, :] = f.P[:, i] = 0.0
        f.x[i], f.P[i, i] = 0.0, SEED_STANDING[i // 3] ** 2
