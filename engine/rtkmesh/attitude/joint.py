"""All that one epoch says of a body's antennas as one measurement with one covariance.

Edges are vectors between two ends: baselines between antennas of the body, positions (a baseline from a fixed base to an antenna), and
headings of receivers. Baselines that share a receiver share its errors, so do positions of one base: every receiver gets a variance of its
own, of which those of the edges are sums; a base's error is common to all antennas, cancels in the attitude and does not average out
in the position. Source: seed_systems.md 3.2 (end) and 3.3. NED, metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import cos, sin, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude.rigid_body import Fit, Layout, Measured, Shape
from rtkmesh.attitude.rotation import angles_per_error
from rtkmesh.attitude.shared_errors import add_shared, variances_of_receivers

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

_OWN_SHARE: Final = 0.25  # of an edge's variance that is no receiver's, where edges close loops: they were solved one by one
_FLOOR_SHARE: Final = 0.05  # of the mean variance that a receiver has at least
_LEAST_M: Final = 1e-4  # no sigma is smaller
_LOOSE: Final = 1.0  # sigma, as a share of the length, across what a heading does not say
_SEEN_SHARE: Final = 0.5  # of the unseen angle's sigma: an angle less certain than this share of it is not seen


@dataclass(frozen=True, slots=True, eq=False)
class Edge:
    """A measured vector (3) from ``start`` to ``end`` with covariance (3x3). Ends that no layout knows are fixed points at the origin.

    ``alone``: its error has nothing to do with that of other edges (a heading that a receiver computed). ``wrong``: probability that its
    integers are.
    """

    start: str
    end: str
    vector_ned_m: Vector
    cov_m2: Matrix
    alone: bool = False
    wrong: float = 0.0


def joint(layout: Layout, edges: Sequence[Edge]) -> Measured:
    """Return the edges as one measurement of the layout's antennas, in their order."""
    signs, ends = _incidence(edges)
    weights = np.zeros((len(edges), len(layout.names)))
    for column, name in enumerate(ends):
        if name in layout.names:
            weights[:, layout.names.index(name)] += signs[:, column]
    return Measured(weights, np.array([edge.vector_ned_m for edge in edges]), _joint_covariance(edges, signs))


def made_positive(cov_m2: Matrix) -> Matrix:
    """Return a covariance (3x3), made positive where rounding in a file left it not so."""
    values, vectors = np.linalg.eigh(0.5 * (cov_m2 + cov_m2.T))
    return (vectors * np.maximum(values, _LEAST_M**2)) @ vectors.T


def heading_edge(
    ends: tuple[str, str], angles_rad: tuple[float, float], sigmas_rad: tuple[float, float], length_m: float, length_sigma_m: float | None
) -> Edge:
    """Return the edge of a heading and pitch (``angles_rad``) of a line of antennas.

    ``length_sigma_m`` None: the length was not measured but is known, and says nothing.
    """
    heading, pitch = angles_rad
    ch, sh, cp, sp = cos(heading), sin(heading), cos(pitch), sin(pitch)
    axes = np.array([[ch * cp, -sh, ch * sp], [sh * cp, ch, sh * sp], [-sp, 0.0, cp]])
    along = _LOOSE * length_m if length_sigma_m is None else length_sigma_m
    sigmas = np.array([along, length_m * sigmas_rad[0] * max(abs(cp), 1e-3), length_m * sigmas_rad[1]])
    return Edge(*ends, length_m * axes[:, 0], axes @ np.diag(sigmas**2) @ axes.T, alone=True)


def _incidence(edges: Sequence[Edge]) -> tuple[Matrix, list[str]]:
    """Return signs (k, m) of the m ends, -1 where an edge starts and 1 where it ends, and the ends' names."""
    ends = sorted({name for edge in edges for name in (edge.start, edge.end)})
    signs = np.zeros((len(edges), len(ends)))
    for row, edge in enumerate(edges):
        signs[row, ends.index(edge.start)] -= 1.0
        signs[row, ends.index(edge.end)] += 1.0
    return signs, ends


def _joint_covariance(edges: Sequence[Edge], signs: Matrix) -> Matrix:
    """Return the covariance (3k, 3k) of all edges."""
    shared = [row for row, edge in enumerate(edges) if not edge.alone]
    own = np.array([edge.cov_m2 for edge in edges])
    total = np.zeros((3 * len(edges), 3 * len(edges)))
    if shared:
        theirs = signs[shared]
        theirs = theirs[:, np.any(theirs != 0.0, axis=0)]
        share = _OWN_SHARE if _closes_loops(theirs.tobytes(), theirs.shape) else 0.0
        variances = receiver_variances(np.abs(theirs), (1.0 - share) * own[shared])
        add_shared(theirs, variances, np.array(shared), total)
        own[shared] *= share
    for row, cov in enumerate(own):
        total[3 * row : 3 * row + 3, 3 * row : 3 * row + 3] += cov
    return total


@lru_cache(maxsize=64)
def _closes_loops(signs: bytes, shape: tuple[int, int]) -> bool:
    return int(np.linalg.matrix_rank(np.frombuffer(signs).reshape(shape))) < shape[0]


@lru_cache(maxsize=64)
def _inverse(members: bytes, shape: tuple[int, int]) -> Matrix:
    return np.linalg.pinv(np.frombuffer(members, np.float64).reshape(shape)).astype(np.float64)


def receiver_variances(members: Matrix, covs_m2: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a covariance (m, 3, 3) per receiver whose sums over an edge's members (k, m of 0 and 1) are nearest to the edges' (k, 3, 3).

    What the edges leave open is shared equally between the ends.
    """
    return variances_of_receivers(members, _inverse(members.tobytes(), members.shape), covs_m2, _FLOOR_SHARE)


def rotation_covariance(found: Fit, unseen_sigma_rad: float) -> Matrix:
    """Return the covariance (3x3, NED, rad^2) of a fit's rotation; a turn that antennas on a line do not see has ``unseen_sigma_rad``."""
    cov = found.cov[:3, :3]
    if found.unseen_ned is None:
        return cov
    return cov + unseen_sigma_rad**2 * np.outer(found.unseen_ned, found.unseen_ned)


def angles_covariance(found: Fit, unseen_sigma_rad: float) -> Matrix:
    """Return the covariance (3x3) of heading, pitch, roll; NaN for an angle that antennas on a line do not see.

    The body is taken to be level about the line, good to ``unseen_sigma_rad``: what that does to the angles that are seen is in them.
    """
    jacobian = angles_per_error(found.ned_from_body)
    cov = jacobian @ rotation_covariance(found, unseen_sigma_rad) @ jacobian.T
    if found.shape is Shape.LINE:
        unseen = np.sqrt(np.diag(cov)) > _SEEN_SHARE * unseen_sigma_rad
        cov[unseen, :] = cov[:, unseen] = np.nan
    return cov


def point_of(found: Fit, body_m: Vector, unseen_sigma_rad: float) -> tuple[Vector, Matrix]:
    """Return where a point of the body is in NED (m), and its covariance (3x3): NaN without a position."""
    place, cov = found.point(body_m)
    if found.unseen_ned is not None:
        moved = unseen_sigma_rad * np.cross(found.unseen_ned, found.ned_from_body @ body_m)
        cov = cov + np.outer(moved, moved)
    return place, cov


def length_m(layout: Layout, start: str, end: str) -> float:
    """Return the distance (m) between two antennas of a layout."""
    between = layout.positions_m[layout.names.index(end)] - layout.positions_m[layout.names.index(start)]
    return sqrt(float(between @ between))
