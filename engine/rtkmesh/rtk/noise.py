"""How much an observation is worth: variances of single differences."""

from math import sin
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel_in_place
from rtkmesh.gnss.signals import SYSTEMS

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

CN0_KNEE_DBHZ: Final = 34.0  # where thermal noise and obstructions double the variance of an open-sky signal
UNALIGNED_CODE_M: Final = 0.6  # two codes of one band: differential code biases of the satellites (IGS DCB products: 0.3 to 1 m) stay in
CLOCK_DRIFT_MPS: Final = 1.5e-3  # satellite clock over the age of a base epoch: 5e-12 s/s (caesium of GPS IIF; rubidium is 5 times better)
IONOSPHERE_PPM: Final = 0.5e-6  # ionospheric gradient that stays in where it is no state
ZENITH_SIGMA_M: Final = 0.02  # by how much zenith delays of two places differ where that is a state
SCALE_PRIOR_DOF: Final = 3.0  # how many residuals the default code sigma is worth against the measured ones
SCALE_MEMORY_DOF: Final = 400.0  # how many are remembered: some tens of seconds at 1 Hz, code multipath lasts as long
SCALE_LEAST: Final = 0.02  # variance factor: survey antennas (0.15 m)
SCALE_MOST: Final = 30.0  # patches between trees (5 m)


@kernel_in_place
def elevation_variance(a_m: float, b_m: float, elevation_rad: float) -> float:
    """Return a^2 + (b / sin elevation)^2 (Euler and Goad 1991 in the form that RTKLIB made common)."""
    s = max(sin(elevation_rad), 0.05)
    return a_m * a_m + b_m * b_m / (s * s)


@kernel_in_place
def cn0_factor(cn0_dbhz: float) -> float:
    """Return the factor of the variance for a carrier to noise density ratio (1 where it is not known).

    Thermal noise goes with 10^(-C/N0 / 10) (Langley 1997); below the knee it outgrows what the elevation model holds.
    """
    if not cn0_dbhz > 0.0:
        return 1.0
    return 1.0 + 10.0 ** (-0.1 * (cn0_dbhz - CN0_KNEE_DBHZ))


PHASE_PRIOR_DOF: Final = 30.0  # what the default phase sigma is worth: one or two epochs with integers
PHASE_MEMORY_DOF: Final = 2000.0  # some minutes: multipath of a place
PHASE_LEAST: Final = 0.02  # variance factor: 0.4 mm, survey antennas under open sky
PHASE_MOST: Final = 4.0  # 6 mm, patch antennas; a wrong fix must not make itself look right by raising it further

# The variance factor of pseudoranges per system is learned from residuals: one default cannot suit survey antennas and patches. Its rows
# are sums of squared normalised residuals and their degrees of freedom; the estimate is the posterior mean of a scaled inverse chi-square
# with SCALE_PRIOR_DOF degrees of freedom at 1. The first two columns of the third row are the same two numbers of all phases; the fourth
# row is what codes in shade are worth (``shade``).
SQUARES, DOF, PHASE, SHADE = range(4)


def new_code_scale() -> Matrix:
    """Return the memory (4, systems) of what codes have shown of their noise: nothing."""
    return np.zeros((4, len(SYSTEMS)))


@kernel_in_place
def code_factors(scale: Matrix, trial: Matrix, out: Vector) -> None:
    """Write the variance factor per system by what is known and the ``trial`` sums and degrees of freedom."""
    for k in range(len(out)):
        raw = (SCALE_PRIOR_DOF + scale[SQUARES, k] + trial[SQUARES, k]) / (SCALE_PRIOR_DOF + scale[DOF, k] + trial[DOF, k])
        out[k] = min(max(raw, SCALE_LEAST), SCALE_MOST)


@kernel_in_place
def learn_codes(scale: Matrix, trial: Matrix) -> None:
    """Take in sums of squared normalised residuals (for a factor of 1) and their degrees of freedom."""
    for k in range(scale.shape[1]):
        squares, dof = scale[SQUARES, k] + trial[SQUARES, k], scale[DOF, k] + trial[DOF, k]
        shrink = min(1.0, SCALE_MEMORY_DOF / max(dof, 1.0))
        scale[SQUARES, k], scale[DOF, k] = squares * shrink, dof * shrink


@kernel_in_place
def phase_factor(scale: Matrix) -> float:
    """Return the variance factor of phases."""
    raw = (PHASE_PRIOR_DOF + scale[PHASE, SQUARES]) / (PHASE_PRIOR_DOF + scale[PHASE, DOF])
    return min(max(raw, PHASE_LEAST), PHASE_MOST)


@kernel_in_place
def learn_phases(scale: Matrix, squares: float, dof: float) -> None:
    """Take in squared phase residuals of a solution with integers, normalised for a factor of 1, and their degrees of freedom.

    Float solutions say nothing: their ambiguities swallow the multipath that a fixed position suffers from.
    """
    squares, dof = scale[PHASE, SQUARES] + squares, scale[PHASE, DOF] + dof
    shrink = min(1.0, PHASE_MEMORY_DOF / max(dof, 1.0))
    scale[PHASE, SQUARES], scale[PHASE, DOF] = squares * shrink, dof * shrink
