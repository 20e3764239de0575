"""Covariances as they are published: docs/concepts/engine.md says what they were measured against.

What the filter says of a fix is meant for validation: its phase factor is raised by floats that disagree with integers, so that these are
not believed too soon. A fix is as good as its phases are with integers in them: their residuals, without a float anywhere, say how good.
"""

from math import isfinite, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place, scratch, scratch_table
from rtkmesh.gnss.frames import enu_from_ecef, geodetic_from_ecef, write_enu, write_geodetic
from rtkmesh.gnss.signals import SATELLITES_PER_SYSTEM
from rtkmesh.rtk.acceptance import FAR_M
from rtkmesh.rtk.asked_odds import is_reflected
from rtkmesh.rtk.noise import PHASE, phase_factor
from rtkmesh.rtk.residuals import Differences
from rtkmesh.rtk.separation import Epochwise, phase_ranges, solve_epoch
from rtkmesh.rtk.state import INTEGER, Filter
from rtkmesh.rtk.update import Layout, Update

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

# Columns of the phases' row of the noise memory that belong to fixes: squared residuals for a factor of 1 and their degrees of freedom.
FIX_SQUARES, FIX_DOF = 2, 3
PRIOR: Final = 0.03  # variance factor before anything was seen: 0.04 (stromlo) to 0.3 (M8P) on recordings, 0.02 to 0.07 in simulation
PRIOR_DOF: Final = 2.0  # what that is worth: less than an epoch
MEMORY_DOF: Final = 500.0  # some tens of epochs; multipath changes within minutes (2000: galway_a_glw1 1.54 instead of 1.39)
LEAST: Final = 0.005  # 0.4 mm per receiver at the zenith: no better phases exist
MOST: Final = 4.0  # as the filter's own
LARGEST_RATIO: Final = 25.0  # of an epoch's variance to the filter's: beyond, an epoch hardly sees one direction
# Of a rover that stands the filter's variance is an epoch's over the number of epochs, as if their multipath were new in each. There an
# epoch hardly sees a direction from this sigma in 3D (m) on: that of the worst fix.
STANDING_M: Final = 0.15
# How much of what a fix owes to earlier epochs, by ambiguities that are not held, counts. 0.4: galway_a_glw1 1.53; 0: 1.30, but
# attitudes at 2 Hz 0.78.
FILTER_SHARE: Final = 0.25
# What satellites do not show against each other because it is smooth over the sky: gradients of ionosphere and troposphere. Simulated runs
# and kanagawa_60s (5.3 km: 3.3 mm) show 0.3 and 1 mm per km; of the filter's own terms the factor takes most.
SMOOTH_HORIZONTAL: Final = 0.35e-6
SMOOTH_VERTICAL: Final = 1.5e-6
# The same of a filter that has ionospheres as states, but between antennas without calibrations hardly a zenith delay. Simulated runs of 10
# and 35 km are in height 1.3 and 1.9 sigmas off without it, nl_35km against its known position 1.2; with it 1.1, 1.0 and 0.9.
FAR_VERTICAL: Final = 0.65e-6
# What of the informed filter's covariance counts, from 10 to 20 km falling to this: it takes errors of orbits, which go with the length and
# are alike on both bands, for noise of each, and is open to ionospheres of active days. Squared errors of its fixes are 0.1 to 0.7 of it
# (stations of 20 to 50 km, quiet to lively days; runs of 35 km, quiet to active), nl_35km 0.2.
FAR_SHARE: Final = 0.55
_FAR_FROM_M, _FAR_ALL_M = 10e3, 20e3
# Sigma in 3D (m) of a fix of few satellites, as it is published, from which it is none where codes tell of reflections: phases are then
# reflected too. Of 66 such fixes in simulated streets 24 were off by more than 0.15 m, of 31 of more satellites none.
VAGUE_M: Final = 0.12
FEW_SATELLITES: Final = 6


@kernel_in_place
def learn_fix(scale: Matrix, squares: float, dof: float) -> None:
    """Take in squared phase residuals of one epoch's position with integers, normalised for a factor of 1, and their degrees of freedom."""
    squares, dof = scale[PHASE, FIX_SQUARES] + squares, scale[PHASE, FIX_DOF] + dof
    shrink = min(1.0, MEMORY_DOF / max(dof, 1.0))
    scale[PHASE, FIX_SQUARES], scale[PHASE, FIX_DOF] = squares * shrink, dof * shrink


@kernel_in_place
def fix_factor(scale: Matrix) -> float:
    """Return the variance factor of the phases of fixes."""
    raw = (PRIOR_DOF * PRIOR + scale[PHASE, FIX_SQUARES]) / (PRIOR_DOF + scale[PHASE, FIX_DOF])
    return min(max(raw, LEAST), MOST)


@kernel
def fix_covariance(
    f: Filter, d: Differences, layout: Layout, update: Update, P: Matrix, scale: Matrix, sure: bool, base_ecef_m: Vector,
    modelled_m: Vector, stands: bool,
) -> Matrix:  # fmt: skip
    """Return the covariance (m2, ECEF) of a fix that ``P`` is the filter's for; learn from its residuals if it is ``sure``.

    It is that of the epoch's own phases, and for a small part the filter's: that knows more, by ambiguities that are not held; but it takes
    multipath of successive epochs for independent. All of it counts where the epoch alone hardly sees a direction.
    ``modelled_m`` is the baseline (ECEF) that the differences were modelled for; ``stands``: the filter knows that the rover does.
    """
    geodetic, turn, back, filters = scratch(3), scratch_table(3, 3), scratch_table(3, 3), phase_factor(scale)
    write_geodetic(base_ecef_m + modelled_m, geodetic)
    write_enu(geodetic[0], geodetic[1], turn)
    for i in range(3):
        for j in range(3):
            back[i, j] = turn[j, i]
    length_m = sqrt(modelled_m[0] ** 2 + modelled_m[1] ** 2 + modelled_m[2] ** 2)
    epoch = solve_epoch(phase_ranges(f, d, layout, update.phase_used, 1.0, turn, length_m > FAR_M))
    if sure and epoch.dof > 0:
        learn_fix(scale, epoch.chi2, float(epoch.dof))
    own = _turned(P, turn, 1.0 / filters)
    factor, largest_m2 = fix_factor(scale), LARGEST_RATIO * (own[0, 0] + own[1, 1] + own[2, 2])
    if stands:
        largest_m2 = max(largest_m2, STANDING_M**2 / factor)
    enu = fix_of_both(own, epoch) if epoch.solved and _is_sound(epoch.cov, largest_m2) else own
    enu *= factor
    enu[0, 0] += (SMOOTH_HORIZONTAL * length_m) ** 2
    enu[1, 1] += (SMOOTH_HORIZONTAL * length_m) ** 2
    enu[2, 2] += (SMOOTH_VERTICAL * length_m) ** 2
    return _turned(enu, back, 1.0)


@kernel
def fix_of_both(own: Matrix, epoch: Epochwise) -> Matrix:
    """Return the covariance (ENU, for phases of the default sigma) of a fix, of its epoch's and the filter's, ``own``.

    The filter has a part by what it remembers, but none if it is less sure than the epoch alone.
    """
    out, share = np.empty((3, 3)), FILTER_SHARE
    if own[0, 0] + own[1, 1] + own[2, 2] > epoch.cov[0, 0] + epoch.cov[1, 1] + epoch.cov[2, 2]:
        share = 0.0
    for i in range(3):
        for j in range(3):
            out[i, j] = (1.0 - share) * epoch.cov[i, j] + share * own[i, j]
    return out


@kernel
def _turned(cov: Matrix, turn: Matrix, scale: float) -> Matrix:
    """Return turn cov turn', scaled, of the first three rows and columns of a covariance."""
    out = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for a in range(3):
                for b in range(3):
                    out[i, j] += scale * turn[i, a] * cov[a, b] * turn[j, b]
    return out


@kernel_in_place
def is_vague(cov_m2: Matrix, level: float, satellites: int) -> bool:
    """Return whether a fix with this covariance (m2) as published, codes of this variance factor and integers of so many satellites is too
    uncertain to be one.
    """
    return is_reflected(level) and satellites <= FEW_SATELLITES and cov_m2[0, 0] + cov_m2[1, 1] + cov_m2[2, 2] > VAGUE_M**2


@kernel_in_place
def held_satellites(f: Filter, d: Differences, layout: Layout) -> tuple[int, int]:
    """Return of how many satellites of this epoch integers are held, and of how many systems these are."""
    satellites, systems, last = 0, 0, -1
    for k in range(len(layout.ambiguity)):
        place, satellite = layout.ambiguity[k], int(d.pairs.satellite[k])
        if place < 0 or satellite == last or not isfinite(f.history[place, INTEGER]):
            continue
        satellites += 1
        if last < 0 or satellite // SATELLITES_PER_SYSTEM != last // SATELLITES_PER_SYSTEM:
            systems += 1
        last = satellite
    return satellites, systems


@kernel
def far_covariance(P: Matrix, base_ecef_m: Vector, baseline_ecef_m: Vector, calibrated: bool) -> Matrix:
    """Return the covariance (m2, ECEF) of a fix by the informed filter, whose own is ``P``; of antennas that are not ``calibrated`` the
    zenith delay is hardly a state.
    """
    length2_m2 = baseline_ecef_m[0] ** 2 + baseline_ecef_m[1] ** 2 + baseline_ecef_m[2] ** 2
    far = min(max((sqrt(length2_m2) - _FAR_FROM_M) / (_FAR_ALL_M - _FAR_FROM_M), 0.0), 1.0)
    out = (1.0 - far * (1.0 - FAR_SHARE)) * P[:3, :3]
    if calibrated:
        return out
    geodetic = geodetic_from_ecef(base_ecef_m + baseline_ecef_m)
    up = enu_from_ecef(geodetic[0], geodetic[1])[2]
    for i in range(3):
        for j in range(3):
            out[i, j] += FAR_VERTICAL**2 * length2_m2 * up[i] * up[j]
    return out


@kernel_in_place
def _is_sound(cov: Matrix, largest_m2: float) -> bool:
    """Return whether a covariance (3 x 3) is one, and not so large that the epoch has hardly seen a direction."""
    square = cov[0, 0] * cov[1, 1] - cov[0, 1] * cov[1, 0]
    cube = cov[2, 2] * square - cov[1, 2] * (cov[0, 0] * cov[2, 1] - cov[0, 1] * cov[2, 0])
    cube += cov[0, 2] * (cov[1, 0] * cov[2, 1] - cov[1, 1] * cov[2, 0])
    return bool(cov[0, 0] > 0.0 and square > 0.0 and cube > 0.0 and cov[0, 0] + cov[1, 1] + cov[2, 2] < largest_m2)
