"""Which log odds one search must have before its integers are believed: what the codes say of the place and the receivers."""

from math import sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.rtk.memory import ACCEPT_AT_ONCE
from rtkmesh.rtk.noise import DOF, SCALE_PRIOR_DOF, SQUARES

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

# Searches with wrong integers and high odds are those of places with reflections, and there the codes are bad. By the variance factor of
# codes (1: 0.6 m in the zenith), of 97000 searches after restarts on recordings and in simulation, the best wrong one had log odds of 3.3
# below SURVEY_CODES, 5.3 from there to FAIR_CODES (patches without much in the way), 5.3 to a factor of 4, 7.9 beyond (streets).
SURVEY_CODES: Final = 0.3
FAIR_CODES: Final = 1.2
ASKED_OF_SURVEY_CODES: Final = 4.0
ASKED_OF_FAIR_CODES: Final = 6.0
DOUBLED_M: Final = 10e3  # one epoch cannot tell its atmosphere: there log odds are worth half (``integrity.sureness``)


@kernel
def code_level(scale: Matrix) -> float:
    """Return the variance factor of all codes together, by what their residuals have shown (``noise``)."""
    return (SCALE_PRIOR_DOF + scale[SQUARES].sum()) / (SCALE_PRIOR_DOF + scale[DOF].sum())


@kernel
def asked_odds(level: float, baseline_m: Vector) -> float:
    """Return the log odds from which one search is believed at once, for codes of this variance factor and this baseline (m)."""
    if level > FAIR_CODES:
        return ACCEPT_AT_ONCE
    near = ASKED_OF_SURVEY_CODES if level <= SURVEY_CODES else ASKED_OF_FAIR_CODES
    length_m = sqrt(baseline_m[0] ** 2 + baseline_m[1] ** 2 + baseline_m[2] ** 2)
    return min(near * (1.0 + length_m / DOUBLED_M), ACCEPT_AT_ONCE)
