"""How long codes have been running, and so how much of what they say now they have said before.

Code multipath lasts for tens of seconds, so the codes of successive epochs do not average out, whatever the rate, and whether or not their
phases run too. A Gauss-Markov process of time constant tau that is observed every dt tells of its mean as much as white noise of 2 tau / dt
times its variance does (its spectral density at low frequencies; Gelb 1974, Applied Optimal Estimation, 2.2).
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place
from rtkmesh.gnss.signals import MAX_SATELLITE, SIGNALS_PER_SATELLITE, band_of
from rtkmesh.rtk.matching import Pairs

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

# Correlation time of code multipath, for what the filter takes from codes: where a phase has run on with the ambiguity that it had (5 s and
# less gave half the fixes on patch antennas), and where none has, so that the filter forgets where it was within seconds.
CARRIED_S: Final = 20.0
ALONE_S: Final = 5.0
_BANDS: Final = 10


def new_codes() -> Matrix:
    """Return when a filter saw the code of each satellite and band (s, on its clock): never."""
    return np.full((MAX_SATELLITE, _BANDS), -np.inf)


@kernel
def since_seen(seen_s: Matrix, pairs: Pairs, coded: NDArray[np.bool_], time_s: float) -> Vector:
    """Return how long ago (s) each pair's code was seen, and note that it is (where ``coded``)."""
    since_s = np.full(len(coded), np.inf)
    for k in range(len(coded)):
        if coded[k]:
            satellite, band = int(pairs.satellite[k]), band_of(pairs.key[k] // SIGNALS_PER_SATELLITE % SIGNALS_PER_SATELLITE)
            since_s[k] = time_s - seen_s[satellite, band]
            seen_s[satellite, band] = time_s
    return since_s


@kernel_in_place
def inflation_of(since_s: float, carried: bool) -> float:
    """Return by how much the variance of a code is inflated that was seen so long ago."""
    memory_s = CARRIED_S if carried else ALONE_S
    return max(2.0 * memory_s / max(since_s, 1e-3), 1.0)
