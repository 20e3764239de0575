"""Where the integers of an epoch put the rover, when epochs follow each other within a second.

The filter takes phases of successive epochs for worse than they are, so that all of a second say of ambiguities what one epoch says at 1 Hz
(``phase_arcs``). But what an epoch says of its own place is not said twice: placed by phases of such variances, the rover goes where
Dopplers and motion lead it from where it was. And where it was a tenth of a second ago is no second witness, for that has the same
multipath in it. At 1 Hz nobody knows so well where it has gone since; so an epoch is placed here.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place
from rtkmesh.rtk.residuals import Differences
from rtkmesh.rtk.state import Filter
from rtkmesh.rtk.update import Layout, update

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

LOOSE_M: Final = 1.0  # sigma of each coordinate on top of what the past says: more than phases and held integers, less than codes


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
        layout.ambiguity, layout.ionosphere, layout.slope, layout.zenith, layout.code_inflation, np.ones(len(layout.phase_inflation))
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
