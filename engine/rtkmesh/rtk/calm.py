"""The atmosphere over baselines of some kilometres: from where on it is a state, and the place of fixes that has nothing of it.

From ``ATMOSPHERE_FROM_M`` on integers are looked for with what the atmosphere may do. For the place of a fix nearer than ``FAR_M`` that is
not as good: what tells an ionosphere are two bands, and their phase centres are centimetres apart, at every antenna otherwise. What it may
have is one number for the whole sky, the part by which the ionosphere exceeds its model: baselines become shorter or longer by it.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place, scratch_table
from rtkmesh.rtk.acceptance import FAR_M
from rtkmesh.rtk.ambiguity import condition
from rtkmesh.rtk.asked_odds import ATMOSPHERE_FROM_M
from rtkmesh.rtk.filter import take_out
from rtkmesh.rtk.matching import count_runs
from rtkmesh.rtk.state import DYNAMIC, EXCESS_KEY, ZENITH_KEY, Filter, is_ionosphere, place_of

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

# On one band, where an ionosphere is nearly as free as an ambiguity, its states are worth it from FAR_M on only.
_TWO_BANDS: Final = 1.5  # signals per satellite


@kernel_in_place
def is_atmospheric(length_m: float, satellite: NDArray[np.int16]) -> bool:
    """Return whether the atmosphere is a state over a baseline of this length; ``satellite`` of each signal, sorted."""
    two_bands = len(satellite) >= _TWO_BANDS * count_runs(satellite)
    return length_m > (ATMOSPHERE_FROM_M if two_bands else FAR_M)


@kernel
def excess_of(f: Filter, held: Indices, integers: Vector) -> float:
    """Return by what part the ionosphere exceeds its model as the held integers have it, whatever each satellite's may be beyond."""
    row, x, P = place_of(f.keys, EXCESS_KEY), np.zeros(1), np.zeros((1, 1))
    if row < 0:
        return 0.0
    condition(f.x, f.P, held, integers, 0.0, np.full(1, DYNAMIC + row), x, P)
    return x[0]


@kernel
def calmed(f: Filter, excess: float) -> Filter:
    """Return the filter given that there is no ionosphere and no zenith delay but for this ``excess`` of the model."""
    x, P, room = f.x.copy(), f.P.copy(), scratch_table(2, len(f.x))
    row = place_of(f.keys, EXCESS_KEY)
    if row >= 0:
        x[DYNAMIC + row] -= excess
        take_out(x, P, DYNAMIC + row, room)
        x[DYNAMIC + row] = excess
    for k in range(len(f.keys)):
        if f.keys[k] == ZENITH_KEY or is_ionosphere(f.keys[k]):
            take_out(x, P, DYNAMIC + k, room)
    return Filter(x, P, f.keys, f.history)
