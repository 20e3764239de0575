"""Which log odds searches must have before their integers are believed: what the codes say of the place and the receivers, and what the
distance leaves open.
"""

from math import isfinite, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel_in_place
from rtkmesh.rtk.memory import ACCEPT_AFTER_STREAK, ACCEPT_AT_ONCE
from rtkmesh.rtk.noise import DOF, SCALE_PRIOR_DOF, SQUARES
from rtkmesh.rtk.state import ZENITH_KEY, Filter, place_of

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

# Searches with wrong integers and high odds are those of places with reflections, and there the codes are bad. By the variance factor of
# codes (1: 0.6 m in the zenith), of 115700 searches after restarts on recordings and in simulation, the best wrong one had log odds of 4.6
# below SURVEY_CODES, 6.6 to FAIR_CODES (patches without much in the way; in a street once 8.2), 7.9 beyond; of 12700 that GLONASS
# witnessed, with codes that were fair, 4.5.
SURVEY_CODES: Final = 0.3
FAIR_CODES: Final = 1.2
ASKED_OF_SURVEY_CODES: Final = 5.0
ASKED_OF_WITNESSED: Final = 6.0
# Beyond STREET_CODES wrong ones of a single search had up to 8.5 (8.9 m off) in simulated streets, and to 10.3 with GLONASS.
STREET_CODES: Final = 4.0
# The same scale says in ``agreement`` where few integers must be proven: where codes are worse than those of patches under trees (1.6).
MIRRORED_CODES: Final = 2.0
ASKED_OF_STREETS: Final = 9.0
WEAK_COUNT: Final = 8  # fewer integers are few
# Residuals do not show what lasts of code multipath: an F9P against an F9P has codes like those of survey antennas. Of 1176 first fixes,
# from log odds of 5 on, of two such antennas that move together (GPS, one band, 1 to 10 Hz; simulated) 53 had six integers, and 6 of
# these were wrong; of the others 7.
SCANT_COUNT: Final = 7
ASKED_OF_SCANT: Final = 6.0
# Nearer, what the atmosphere leaves is below the phases' multipath.
ATMOSPHERE_FROM_M: Final = 4e3
DOUBLED_M: Final = 10e3  # one epoch cannot tell its atmosphere: there log odds are worth half (``integrity.sureness``)


@kernel_in_place
def code_level(scale: Matrix) -> float:
    """Return the variance factor of all codes together, by what their residuals have shown (``noise``)."""
    return (SCALE_PRIOR_DOF + scale[SQUARES].sum()) / (SCALE_PRIOR_DOF + scale[DOF].sum())


@kernel_in_place
def at_least_street(level: float) -> float:
    """Return the level of codes that reflections were put aside of: those that are left do not tell any more what place it is."""
    return max(level, 2.0 * STREET_CODES)


@kernel_in_place
def is_reflected(level: float) -> bool:
    """Return whether codes of this variance factor (infinite: not known) are worse than those of patches in the open."""
    return are_worse(level, FAIR_CODES)


@kernel_in_place
def is_street(level: float) -> bool:
    """Return whether codes of this variance factor (infinite: not known) are those of a place with many reflections."""
    return are_worse(level, STREET_CODES)


@kernel_in_place
def are_worse(level: float, limit: float) -> bool:
    """Return whether codes of this variance factor are known to be worse than those of a place: the one question that FAIR_CODES,
    MIRRORED_CODES and STREET_CODES answer to. Codes that are not known (infinite) are no worse.
    """
    return isfinite(level) and level > limit


@kernel_in_place
def asked_odds(level: float, witnessed: bool, baseline_m: Vector) -> float:
    """Return the log odds from which one search is believed at once, for codes of this variance factor and this baseline (m); ``witnessed``
    is one whose odds are those with GLONASS (``witness``).
    """
    if is_street(level):
        return ASKED_OF_STREETS
    near = ACCEPT_AT_ONCE
    if level <= SURVEY_CODES:
        near = ASKED_OF_SURVEY_CODES
    elif witnessed and level <= FAIR_CODES:
        near = ASKED_OF_WITNESSED
    return _at_length(near, baseline_m)


@kernel_in_place
def asked_of_scant(level: float) -> float:
    """Return the log odds that fewer than SCANT_COUNT integers must have in any case, however long searches have given them, for codes of
    this variance factor: codes that seem to be those of survey antennas may have errors that last.
    """
    return ASKED_OF_SCANT if level <= SURVEY_CODES else 0.0


@kernel_in_place
def is_felt(f: Filter) -> bool:
    """Return whether the baseline is so long that integers feel its atmosphere."""
    return bool(f.x[0] ** 2 + f.x[1] ** 2 + f.x[2] ** 2 > ATMOSPHERE_FROM_M**2)


@kernel_in_place
def odds_of_lasting(f: Filter, count: int) -> float:
    """Return the log odds from which so many integers are believed that searches have given for long enough and nothing else bears out.

    Where the atmosphere is felt and no state it is taken for noise that is new in every epoch, but it lasts as long as a few wrong integers
    that it makes fit.
    """
    knows = not is_felt(f) or count >= WEAK_COUNT or place_of(f.keys, ZENITH_KEY) >= 0
    return ACCEPT_AFTER_STREAK if knows else _at_length(ACCEPT_AFTER_STREAK, f.x)


@kernel_in_place
def _at_length(near: float, baseline_m: Vector) -> float:
    """Return what is asked over a baseline that begins these states (m), of what is asked at the base."""
    length_m = sqrt(baseline_m[0] ** 2 + baseline_m[1] ** 2 + baseline_m[2] ** 2)
    return min(near * (1.0 + length_m / DOUBLED_M), ACCEPT_AT_ONCE)
