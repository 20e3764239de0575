"""Where the integers of an epoch put the rover, when epochs follow each other within a second.

The filter takes phases of successive epochs for worse than they are, so that all of a second say of ambiguities what one epoch says at 1 Hz
(``phase_arcs``). But what an epoch says of its own place is not said twice: placed by phases of such variances, the rover goes where
Dopplers and motion lead it from where it was. And where it was a tenth of a second ago is no second witness, for that has the same
multipath in it. At 1 Hz nobody knows so well where it has gone since; so an epoch is placed here.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place, scratch_indices
from rtkmesh.rtk.ambiguity import condition, norm_of
from rtkmesh.rtk.calm import place_calmly
from rtkmesh.rtk.residuals import Differences
from rtkmesh.rtk.state import Filter
from rtkmesh.rtk.update import Layout, update

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

LOOSE_M: Final = 1.0  # sigma of each coordinate on top of what the past says: more than phases and held integers, less than codes


class Placing(NamedTuple):
    """Which integers are held (``pairs`` of state and reference) and where they put the rover: the filter ``f`` by which they are believed,
    and the one that says where, with the same states; ``apart``: this is another one, of the epoch alone; ``calm``: the place has little
    of the atmosphere's states.
    """

    f: Filter
    place: Filter
    pairs: Indices
    apart: bool
    calm: bool


@kernel
def by_itself(f: Filter, pairs: Indices) -> Placing:
    """Return the filter by which integers are believed as what places them."""
    return Placing(f, f, pairs, False, False)


@kernel
def place_integers(p: Placing, integers: Vector, x: Vector, P: Matrix) -> float:
    """Write the dynamic states and their covariance given integers; return their squared norm by the filter by which they are believed."""
    dynamic = scratch_indices(len(x))
    for i in range(len(x)):
        dynamic[i] = i
    if p.calm:
        norm = place_calmly(p.place, p.pairs, integers, dynamic, x, P)
    else:
        norm = condition(p.place.x, p.place.P, p.pairs, integers, 0.0, dynamic, x, P)
    return norm_of(p.f, p.pairs, integers) if p.apart else norm


@kernel_in_place
def is_dense(layout: Layout) -> bool:
    """Return whether phases of this epoch are weighted for less than they are."""
    dense = False
    for inflation in layout.phase_inflation:
        dense = dense or bool(inflation > 1.0)
    return dense


@kernel
def in_full(layout: Layout) -> Layout:
    """Return the layout of an epoch whose phases count in full."""
    return Layout(
        layout.ambiguity,
        layout.ionosphere,
        layout.slope,
        layout.zenith,
        layout.excess,
        layout.code_inflation,
        np.ones(len(layout.phase_inflation)),
    )


@kernel
def place_by_epoch(
    prior: Filter, d: Differences, layout: Layout, scale: Matrix, velocity_mps: Vector, velocity_cov_m2ps2: Matrix
) -> Filter:
    """Return the filter of before the epoch, the place left open, updated by phases that count in full (``layout``): for the place of a
    fix, not for what is believed of its integers. The noise memory ``scale`` learns nothing.
    """
    f = Filter(prior.x.copy(), prior.P.copy(), prior.keys, prior.history)
    for i in range(3):
        f.P[i, i] += LOOSE_M * LOOSE_M
    update(f, d, layout, scale.copy(), velocity_mps, velocity_cov_m2ps2)
    return f
