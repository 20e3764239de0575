"""The joint covariance of a layout from what its antennas say of themselves and of each other, and back."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude.rigid_body import Layout

Matrix = NDArray[np.float64]
Triple = tuple[float, float, float]
Blocks = Mapping[str, tuple[float, ...]]


def blocks_of(layout: Layout) -> dict[str, dict[str, tuple[float, ...]]]:
    """Return per antenna the covariances (3x3, row-major, m^2) of its place with its own and with those of the antennas before it."""
    if layout.cov_m2 is None:
        return {}
    n = len(layout.names)
    blocks = layout.cov_m2.reshape(n, 3, n, 3)
    return {
        name: {other: tuple(blocks[i, :, j, :].ravel().tolist()) for j, other in enumerate(layout.names[: i + 1])}
        for i, name in enumerate(layout.names)
    }


def joint_covariance(sigmas_m: Mapping[str, Triple], blocks: Mapping[str, Blocks]) -> Matrix | None:
    """Return the joint covariance (3n, 3n) of places in the order of ``sigmas_m``; None where all is exact.

    Antennas with ``blocks`` of themselves are correlated as these say; the others have their sigmas and nothing in common. What rounding
    in a file made negative is made zero.
    """
    names = list(sigmas_m)
    cov = np.zeros((len(names), 3, len(names), 3))
    for i, name in enumerate(names):
        told = blocks.get(name, {})
        cov[i, :, i, :] = np.diag(np.square(sigmas_m[name]))
        for other, values in told.items() if name in told else ():
            if other in names and other in blocks.get(other, {}):
                j, block = names.index(other), np.array(values).reshape(3, 3)
                cov[i, :, j, :], cov[j, :, i, :] = block, block.T
    return _positive(cov.reshape(3 * len(names), -1)) if cov.any() else None


def _positive(cov_m2: Matrix) -> Matrix:
    values, vectors = np.linalg.eigh(0.5 * (cov_m2 + cov_m2.T))
    return cov_m2 if values[0] >= 0.0 else (vectors * np.maximum(values, 0.0)) @ vectors.T
