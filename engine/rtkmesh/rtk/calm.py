"""The atmosphere over baselines of some kilometres: from where on it is a state, and the place of fixes that has nothing of it.

From ``ATMOSPHERE_FROM_M`` on integers are looked for with what the atmosphere may do. For the place of a fix nearer than ``FAR_M`` that is
not as good: what tells an ionosphere are two bands, and their phase centres are centimetres apart, at every antenna otherwise.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place
from rtkmesh.rtk.acceptance import FAR_M
from rtkmesh.rtk.filter import posterior
from rtkmesh.rtk.matching import count_runs
from rtkmesh.rtk.state import DYNAMIC, ZENITH_KEY, Filter, is_ionosphere

# Nearer, what the atmosphere leaves is below the phases' multipath; on one band, where an ionosphere is nearly as free as an ambiguity, the
# states are worth it from FAR_M on only.
ATMOSPHERE_FROM_M: Final = 4e3
_TWO_BANDS: Final = 1.5  # signals per satellite
_CALM_M: Final = 1e-5  # far below what two bands show of an ionosphere


@kernel_in_place
def is_atmospheric(length_m: float, satellite: NDArray[np.int16]) -> bool:
    """Return whether the atmosphere is a state over a baseline of this length; ``satellite`` of each signal, sorted."""
    two_bands = len(satellite) >= _TWO_BANDS * count_runs(satellite)
    return length_m > (ATMOSPHERE_FROM_M if two_bands else FAR_M)


@kernel
def calmed(f: Filter) -> Filter:
    """Return the filter that has been told of no ionosphere and no zenith delay at all; itself if that cannot be."""
    n = len(f.x)
    N, b, P, dx = np.zeros((n, n)), np.zeros(n), np.empty((n, n)), np.empty(n)
    for k in range(len(f.keys)):
        if f.keys[k] == ZENITH_KEY or is_ionosphere(f.keys[k]):
            i = DYNAMIC + k
            N[i, i], b[i] = 1.0 / _CALM_M**2, -f.x[i] / _CALM_M**2
    return Filter(f.x + dx, P, f.keys, f.history) if posterior(f.P, N, b, P, dx) == 0 else f
