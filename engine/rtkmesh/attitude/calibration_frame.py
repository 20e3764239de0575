"""Axes of a calibrated layout: by definition, with the covariance that the definition gives (S-transformation).

The origin is an antenna or the centroid, x points from the first antenna to the second, y lies in the plane of the first three that are
not on one line, z is the plane's normal that points down in the mean. What the definition holds fixed has no error: it is in the other
coordinates. Source: W. Baarda, "S-transformations and criterion matrices" (1973).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude.rigid_body import Shape
from rtkmesh.attitude.rotation import skew

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Axes:
    """How to get from any axes to defined ones: ``rotation`` (3x3) new from old, ``third`` the antenna that sets the plane (-1: none)."""

    rotation: Matrix
    third: int


def defined_axes(places_m: Matrix, shape: Shape, down: Vector) -> Axes:
    """Return the axes of antennas at ``places_m`` (n, 3); ``down`` is the mean direction of gravity in their present axes."""
    x = places_m[1] - places_m[0]
    x = x / np.linalg.norm(x)
    third = -1 if shape is Shape.LINE else _third(places_m, x)
    if third < 0:
        z = down - x * float(x @ down)
        z = z / np.linalg.norm(z) if float(np.linalg.norm(z)) > 1e-6 else _any_across(x)
    else:
        z = skew(x) @ (places_m[third] - places_m[0])
        z = z * (1.0 if float(z @ down) >= 0.0 else -1.0) / np.linalg.norm(z)
    return Axes(np.stack([x, skew(z) @ x, z]), third)


def _third(places_m: Matrix, x: Vector) -> int:
    """Return the first antenna that is clearly off the line of the first two."""
    arms = places_m - places_m[0]
    off = np.linalg.norm(arms - np.outer(arms @ x, x), axis=1)
    return int(np.flatnonzero(off[2:] > 0.3 * off.max())[0]) + 2


def _any_across(x: Vector) -> Vector:
    z = skew(x) @ np.eye(3)[int(np.argmin(np.abs(x)))]
    return z / np.linalg.norm(z)


def in_axes(places_m: Matrix, cov_m2: Matrix, axes: Axes, origin: int | None) -> tuple[Matrix, Matrix]:
    """Return places (n, 3) and covariance (3n, 3n) in defined axes; ``origin``: an antenna's number, None: the centroid."""
    n = len(places_m)
    turned = places_m @ axes.rotation.T
    turned = turned - (turned.mean(axis=0) if origin is None else turned[origin])
    wide = np.kron(np.eye(n), axes.rotation)
    free = np.vstack([np.hstack([np.eye(3), -skew(place)]) for place in turned])
    held = _held(n, axes.third, origin)
    if axes.third < 0:  # along the line only
        free, held = free[:, :1], held[:1]
    transform = np.eye(3 * n) - free @ np.linalg.solve(held @ free, held)
    transform = transform @ wide
    return turned, transform @ cov_m2 @ transform.T


def _held(antennas: int, third: int, origin: int | None) -> Matrix:
    """Return the rows of what the definition holds fixed: origin, and turns about z, y, x by the second and third antenna."""
    rows = np.zeros((6, 3 * antennas))
    rows[:3] = (
        np.kron(np.full((1, antennas), 1.0 / antennas), np.eye(3)) if origin is None else np.eye(3 * antennas)[3 * origin : 3 * origin + 3]
    )
    rows[3, [4, 1]] = 1.0, -1.0
    rows[4, [5, 2]] = 1.0, -1.0
    rows[5, [3 * third + 2, 2]] = 1.0, -1.0
    return rows
