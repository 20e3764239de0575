"""How long phases have been running, and so how much of what they say now they have said before.

Phase multipath lasts for seconds, as that of codes does (``code_arcs``). The filter takes what epochs say at 1 Hz for independent, and so
measured is all that is asked of odds. At 10 Hz there are ten times as many epochs in the same seconds, with the same errors.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.rtk.state import ARC_EPOCHS, SEEN_S

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

INDEPENDENT_S: Final = 0.9  # phases that are so far apart count in full: at 1 Hz all do
ALIKE_S: Final = 1.0  # of those nearer to each other so many seconds say what one does


@kernel
def phase_inflations(history: Matrix, place: Indices, time_s: float) -> Vector:
    """Return by how much the variance of each phase is inflated, so that all of a second say together what one does; ``place`` is where the
    ambiguities are in the history (-1: nowhere). A phase that begins anew counts in full.
    """
    out = np.ones(len(place))
    for k in range(len(place)):
        if place[k] >= 0 and history[place[k], ARC_EPOCHS] > 0.0:
            since_s = time_s - history[place[k], SEEN_S]
            out[k] = ALIKE_S / max(since_s, 1e-3) if since_s < INDEPENDENT_S else 1.0
    return out
