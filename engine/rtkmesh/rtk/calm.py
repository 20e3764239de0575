"""The atmosphere over baselines of some kilometres: from where on it is a state, and the place of fixes that has nothing of it.

From ``ATMOSPHERE_FROM_M`` on integers are looked for with what the atmosphere may do. For the place of a fix nearer than ``FAR_M`` that is
not as good: what tells an ionosphere are two bands, and their phase centres are centimetres apart, at every antenna otherwise. What it may
have is one number for the whole sky, the part by which the ionosphere exceeds its model: baselines become shorter or longer by it. But
where the atmosphere is active, the place that has nothing of the others is off by more than that.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place, scratch, scratch_indices, scratch_table
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
# How far the place with the atmosphere's states may be off the one without them by antennas alone: kanagawa_60s (5.3 km) has 35 mm. In
# simulation, where antennas are perfect, places that are no more than 2 cm apart are equally good; 5 to 7 cm apart the one without is 13 cm
# off (rms, 172 fixes of 7 to 10 km), the one with the states 8 cm, from 10 cm on 18 and 6 cm.
ANTENNAS_M: Final = 0.04


@kernel_in_place
def is_atmospheric(length_m: float, satellite: NDArray[np.int16]) -> bool:
    """Return whether the atmosphere is a state over a baseline of this length; ``satellite`` of each signal, sorted."""
    two_bands = len(satellite) >= _TWO_BANDS * count_runs(satellite)
    return length_m > (ATMOSPHERE_FROM_M if two_bands else FAR_M)


@kernel
def place_calmly(f: Filter, pairs: Indices, integers: Vector, dynamic: Indices, x: Vector, P: Matrix) -> float:
    """Write the dynamic states and their covariance given integers: without an atmosphere but for its excess, as the integers have it
    whatever each satellite's may be beyond; and with all its states for the share of these. Return the squared norm of the integers.
    """
    n, row = len(x), place_of(f.keys, EXCESS_KEY)
    count = n if row < 0 else n + 1
    felt_x, felt_P, wanted = scratch(n + 1), scratch_table(n + 1, n + 1), scratch_indices(n + 1)
    wanted[:n], wanted[n] = dynamic, DYNAMIC + row
    norm = condition(f.x, f.P, pairs, integers, 0.0, wanted[:count], felt_x, felt_P)
    calm = calmed(f, felt_x[n] if count > n and norm < np.inf else 0.0)
    condition(calm.x, calm.P, pairs, integers, 0.0, dynamic, x, P)
    if norm == np.inf:
        return norm
    apart_m2, variance_m2 = 0.0, 0.0
    for i in range(3):
        apart_m2 += (felt_x[i] - x[i]) ** 2
        variance_m2 += felt_P[i, i] - P[i, i]  # of their difference: one is the other given something
    share = share_of_states(apart_m2, variance_m2)
    for i in range(len(x)):
        x[i] += share * (felt_x[i] - x[i])
        for j in range(len(x)):
            P[i, j] += share * (felt_P[i, j] - P[i, j])
    return norm


@kernel_in_place
def share_of_states(apart_m2: float, variance_m2: float) -> float:
    """Return for how much the place with the atmosphere's states counts whose squared distance to the one without (m2) would be
    ``variance_m2`` by noise: the share that neither this nor antennas explain (James and Stein 1961, the positive part).
    """
    explained_m2 = max(variance_m2, 0.0) + ANTENNAS_M**2
    return 1.0 - explained_m2 / apart_m2 if apart_m2 > explained_m2 else 0.0


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
