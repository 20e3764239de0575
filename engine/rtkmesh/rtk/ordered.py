"""Numbers in order, for medians; by insertion, for they are few."""

from math import isfinite

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel_in_place

Vector = NDArray[np.float64]


@kernel_in_place
def sort_finite(values: Vector, ordered: Vector) -> int:
    """Write the finite values in rising order; return how many there are."""
    n = 0
    for value in values:
        if not isfinite(value):
            continue
        place = n
        while place > 0 and ordered[place - 1] > value:
            ordered[place] = ordered[place - 1]
            place -= 1
        ordered[place] = value
        n += 1
    return n
