"""Signals in shade, and whether what arrives there has come by way of a wall.

Behind a house a receiver hears a satellite by a reflection: weaker, by a longer path. Code and phase are off by metres then, those of all
satellites on that side alike, and no residual of a solution that believes them shows it. Behind a tree a signal is as weak, and right. What
tells both apart are the codes: where those in shade are far worse, against the place of those in the light, than their C/N0 explains, they
are reflections, and so are the phases that came with them.

A signal is in shade where the rover hears it less well than the base does, by more than of others of its clock group: satellite, elevation
and season are the same at both ends, receivers and antennas those of all signals of the group.
"""

from math import isfinite
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place, scratch, scratch_flags, scratch_table
from rtkmesh.gnss.frames import write_enu, write_geodetic
from rtkmesh.gnss.signals import GLONASS, SATELLITES_PER_SYSTEM
from rtkmesh.rtk.code_errors import residual
from rtkmesh.rtk.noise import SHADE
from rtkmesh.rtk.residuals import CODE, CODE_VARIANCE, GAIN_DB, PHASE, Differences
from rtkmesh.rtk.separation import CLOCK, UNKNOWNS, Epochwise, Ranges, code_ranges, solve_epoch
from rtkmesh.rtk.state import INTEGER, Filter, place_of

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Flags = NDArray[np.bool_]

SHADE_DB: Final = 7.0  # weaker by this than a quarter of the group
LEAST_GROUP: Final = 3  # signals of a group that can tell which of them are weak
# Sums of squares in the memory of the noise, and their degrees of freedom: of codes in shade and of those in the light, normalised by what
# elevation and C/N0 explain. A wall stays for some tens of seconds.
SHADED, SHADED_DOF, LIT, LIT_DOF = range(4)
PRIOR_DOF: Final = 10.0
SHADED_MOST: Final = 200.0
LIT_MOST: Final = 400.0
MOST_PER_DOF: Final = 900.0  # a code that is farther off is no reflection
# So much worse, in variance, are reflections at least: simulated streets have 2 to 48, forests 0.7 to 1; umea_r001 (trees) has 0.6 to 1.2,
# the walk of galway_b 2 to 12 and 5 to 38 (10 and 90 %).
REFLECTED: Final = 7.0
ENOUGH: Final = 5  # satellites in the light that can do without the others
REFLECTED_CODE_M: Final = 30.0  # sigma: longer ways than these are not often followed by a receiver


@kernel
def leave_shade(f: Filter, d: Differences, scale: Matrix, model_ecef_m: Vector) -> bool:
    """Put reflected signals aside, and return whether there are any: of those in shade, where these are reflections and the others are
    enough, codes say hardly anything and phases nothing, but those of held integers. ``scale`` learns what codes in shade are worth;
    the differences were modelled for a rover at ``model_ecef_m``.
    """
    shaded = scratch_flags(len(d.table))
    if find_shaded(d, shaded) == 0:
        return False
    learn_shade(d, shaded, scale, model_ecef_m)
    if not is_reflecting(scale) or _lit_satellites(d, shaded) < ENOUGH:
        return False
    _put_aside(f, d, shaded)
    return True


@kernel_in_place
def find_shaded(d: Differences, out: Flags) -> int:
    """Write which signals are in shade; return how many."""
    count, strongest_db = 0, -np.inf
    for k in range(len(out)):
        if d.table[k, GAIN_DB] > strongest_db:
            strongest_db = d.table[k, GAIN_DB]
    for k in range(len(out)):
        out[k] = strongest_db > d.table[k, GAIN_DB] + SHADE_DB and _is_shaded(d, k)
        count += 1 if out[k] else 0
    return count


@kernel_in_place
def _is_shaded(d: Differences, k: int) -> bool:
    """Return whether a quarter of a signal's group is stronger by SHADE_DB."""
    members, stronger = 0, 0
    for j in range(len(d.table)):
        if d.pairs.group[j] == d.pairs.group[k] and isfinite(d.table[j, GAIN_DB]):
            members += 1
            stronger += 1 if d.table[j, GAIN_DB] > d.table[k, GAIN_DB] + SHADE_DB else 0
    return bool(members >= LEAST_GROUP and stronger > 0 and 4 * stronger >= members)


@kernel
def learn_shade(d: Differences, shaded: Flags, scale: Matrix, model_ecef_m: Vector) -> None:
    """Take in how far the codes in shade are off where those in the light put the rover, and how far these are."""
    factors, geodetic, turn, used = scratch(scale.shape[1]), scratch(3), scratch_table(3, 3), scratch_flags(len(shaded))
    factors[:] = 1.0
    for k in range(len(used)):  # GLONASS codes are off by channel
        used[k] = int(d.pairs.satellite[k]) // SATELLITES_PER_SYSTEM != GLONASS
    write_geodetic(model_ecef_m, geodetic)
    write_enu(geodetic[0], geodetic[1], turn)
    ranges = code_ranges(d, used, factors, turn)
    variance_m2 = scratch(len(shaded))
    for k in range(len(shaded)):
        variance_m2[k] = 1.0 / ranges.weight[k] if ranges.weight[k] > 0.0 else np.nan
        ranges.weight[k] = 0.0 if shaded[k] else ranges.weight[k]
    epoch = solve_epoch(ranges)
    if not epoch.solved or epoch.dof < 0:
        return
    _add(scale, LIT, min(epoch.chi2, MOST_PER_DOF * epoch.dof), float(epoch.dof), LIT_MOST)
    for k in range(len(shaded)):
        if shaded[k] and isfinite(variance_m2[k]) and epoch.sums[ranges.group[k], CLOCK, CLOCK] > 0.0:
            square = residual(ranges, epoch, k) ** 2 / (variance_m2[k] + _variance_of_prediction(ranges, epoch, k))
            _add(scale, SHADED, min(square, MOST_PER_DOF), 1.0, SHADED_MOST)


@kernel_in_place
def _variance_of_prediction(ranges: Ranges, epoch: Epochwise, k: int) -> float:
    """Return the variance (m2) of what the place and the clock of an epoch say of a range that is not used."""
    sums, row = epoch.sums[ranges.group[k]], scratch(UNKNOWNS)
    for i in range(UNKNOWNS):
        row[i] = ranges.rows[k, i] - sums[i, CLOCK] / sums[CLOCK, CLOCK]
    total = 1.0 / sums[CLOCK, CLOCK]
    for i in range(UNKNOWNS):
        for j in range(UNKNOWNS):
            total += row[i] * epoch.cov[i, j] * row[j]
    return total


@kernel_in_place
def _add(scale: Matrix, place: int, squares: float, dof: float, most: float) -> None:
    """Add squares and their degrees of freedom (the next column), of which so many are remembered."""
    scale[SHADE, place] += squares
    scale[SHADE, place + 1] += dof
    shrink = min(1.0, most / max(scale[SHADE, place + 1], 1.0))
    scale[SHADE, place] *= shrink
    scale[SHADE, place + 1] *= shrink


@kernel_in_place
def is_reflecting(scale: Matrix) -> bool:
    """Return whether codes in shade have shown to be reflections."""
    shaded = (PRIOR_DOF + scale[SHADE, SHADED]) / (PRIOR_DOF + scale[SHADE, SHADED_DOF])
    return bool(shaded > REFLECTED * (PRIOR_DOF + scale[SHADE, LIT]) / (PRIOR_DOF + scale[SHADE, LIT_DOF]))


@kernel_in_place
def _lit_satellites(d: Differences, shaded: Flags) -> int:
    """Return how many satellites have a code in the light (pairs are sorted by satellite)."""
    count, last = 0, -1
    for k in range(len(shaded)):
        if not shaded[k] and isfinite(d.table[k, CODE]) and d.pairs.satellite[k] != last:
            last = int(d.pairs.satellite[k])
            count += 1
    return count


@kernel_in_place
def _put_aside(f: Filter, d: Differences, shaded: Flags) -> None:
    """Let codes in shade say hardly anything, and phases nothing but those of held integers."""
    for k in range(len(shaded)):
        if not shaded[k]:
            continue
        d.table[k, CODE_VARIANCE] += REFLECTED_CODE_M**2
        place = place_of(f.keys, d.pairs.key[k])
        if place < 0 or not isfinite(f.history[place, INTEGER]):
            d.table[k, PHASE] = np.nan
