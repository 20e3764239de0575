"""One epoch in one compiled call: the filters moved on to it, then its relative solution."""

from math import isfinite, sqrt
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.gnss.epoch import Signals
from rtkmesh.models.single import Located, Plain
from rtkmesh.models.single_adjustment import CONVERGED
from rtkmesh.rtk.bookkeeping import Motion, advance, seed
from rtkmesh.rtk.crossing import named, unnamed
from rtkmesh.rtk.relative import SOLVED, UNCLEAR, Known, Setup, solve_pair, unsolved, walks_of
from rtkmesh.rtk.state import DYNAMIC, HISTORY, SEED_MOVING, Filter

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

ASTRAY: Final = UNCLEAR + 1  # beside those of ``relative``: the filters must begin anew
# By so much (m per square root of second) the place of a rover that stands is free in the informed filter: what is left of the atmosphere
# comes and goes within minutes, and integers of a place that was known to 3 mm strained it.
STANDING_WALK_M: Final = 0.01
_FAR_M: Final = 200.0  # a prediction that is off the single-point position by more is not believed


class Step(NamedTuple):
    """How the filters reach an epoch: after ``dt_s`` (NaN: they begin with it) from where the base was then (ECEF, m), on a baseline of
    ``length_m``.

    ``moves``: the rover or the baseline does. ``reseeds``: its position and motion begin anew with the single point. ``shifts``: another
    base position is another baseline. ``strays``: a prediction far off the single-point position is not believed.
    """

    dt_s: float
    base_ecef_m: Vector
    length_m: float
    moves: bool
    reseeds: bool
    shifts: bool
    strays: bool
    motion: Motion


@kernel
def take_step(
    filters: tuple[Plain, Plain], signals: tuple[Plain, Plain], place: Plain, channel: NDArray[np.int8], klobuchar: Vector, way: Plain,
    past: Plain, options: Plain,
) -> Plain:  # fmt: skip
    """Return the relative solution of an epoch, as ``solve_pair`` does, with the filters (written to) that the last one left; ASTRAY
    where these cannot go on.

    Fields come without names: of both filters, of the signals of rover and base, of Located, Step (and Motion in it), Known, and Setup as
    ``plain`` has it; and they go so, as ``unnamed`` has them.
    """
    f, informed, rover, base = Filter(*filters[0]), Filter(*filters[1]), Signals(*signals[0]), Signals(*signals[1])
    located, known, setup = Located(*place), Known(*past), named(options)
    step = Step(way[0], way[1], way[2], way[3], way[4], way[5], way[6], Motion(*way[7]))
    informed, moved = move_on(f, informed, located, step, known, setup)
    if not moved:
        return unnamed(unsolved(ASTRAY, f, informed))
    model_ecef_m = known.base_ecef_m + f.x[:3]
    solved = solve_pair(f, informed, rover, base, located, channel, klobuchar, known, setup)
    if solved.status == SOLVED:
        known.last_model_ecef_m[:] = model_ecef_m
    return unnamed(solved)


@kernel
def move_on(f: Filter, informed: Filter, located: Located, step: Step, known: Known, setup: Setup) -> tuple[Filter, bool]:
    """Move both filters on; return the informed one, and whether they can be gone on with."""
    if not isfinite(step.dt_s):
        return informed, True
    if step.reseeds:
        place_m = located.position_ecef_m - step.base_ecef_m
        seed(f, place_m, SEED_MOVING)
        seed(informed, place_m, SEED_MOVING)
    walks, moves = walks_of(setup, step.length_m, known.memory), step.moves and not step.reseeds
    if len(informed.keys) > 0 and not advance(informed, step.dt_s, moves, step.motion, step.base_ecef_m, walks, SEED_MOVING):
        informed = Filter(np.zeros(DYNAMIC), np.zeros((DYNAMIC, DYNAMIC)), np.zeros(0, np.int64), np.zeros((0, HISTORY)))
    if known.stands and len(informed.keys) > 0:
        for i in range(3):
            informed.P[i, i] += STANDING_WALK_M**2 * step.dt_s
    if not advance(f, step.dt_s, moves, step.motion, step.base_ecef_m, walks, SEED_MOVING):
        return informed, False
    if step.strays and located.status == CONVERGED and _is_astray(f, located, step.base_ecef_m):
        return informed, False
    if step.shifts:
        shift_m = known.base_ecef_m - step.base_ecef_m
        f.x[:3] -= shift_m
        informed.x[:3] -= shift_m
    return informed, True


@kernel
def _is_astray(f: Filter, located: Located, base_ecef_m: Vector) -> bool:
    """Return whether the predicted position is too far off the single-point one."""
    cov = located.covariance_m2
    gap_m = base_ecef_m + f.x[:3] - located.position_ecef_m
    return sqrt(gap_m[0] ** 2 + gap_m[1] ** 2 + gap_m[2] ** 2) > _FAR_M + 5.0 * sqrt(cov[0, 0] + cov[1, 1] + cov[2, 2])
