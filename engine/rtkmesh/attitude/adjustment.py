"""Where the antennas of a body are, from many instants at once: one layout, a rotation and a place of the body per instant.

Gauss-Newton on all of it together: what each instant alone needs (rotation, and origin where positions were measured) is taken out of the
normal equations at once (Schur complement), so only the layout is left, whatever the number of instants. The layout's own place and
rotation cannot be known: the step is the shortest one (free adjustment), and ``calibration_frame`` puts the result into axes.
Source: seed_systems.md 3.3 (calibration); H. Wolf, "Das geodaetische Gauss-Helmert-Modell" (1978) for the elimination.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude.rigid_body import Measured

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Numbers = NDArray[np.int64]

_UNSEEN: Final = 1e-9  # eigenvalues below this share of the largest one are of what cannot be seen
_SWALLOWED: Final = 0.02  # residuals with a smaller share of the variance say nothing of it
_STEPS: Final = 60
_CONVERGED: Final = 1e-8  # m, rad
_SHRINKING: Final = 0.7


@dataclass(slots=True, eq=False)
class Group:
    """Instants that measured the same mixes of antennas: arrays over them. ``at`` (e) are their numbers among all instants."""

    at: Numbers
    weights: Matrix  # (k, n)
    values_m: Matrix  # (e, k, 3)
    cov_m2: Matrix  # (e, 3k, 3k)
    rotation: Matrix  # (e, 3, 3), ned_from_body
    origin_m: Matrix  # (e, 3)
    step_share: Vector  # (e) part of a step that is made
    last_turn_rad: Vector  # (e)

    @property
    def absolute(self) -> bool:
        """Whether positions are among what was measured."""
        return bool(np.any(np.abs(self.weights.sum(axis=1)) > 1e-9))

    def residuals_m(self, places_m: Matrix) -> Matrix:
        """Return measured minus predicted (e, k, 3) for antennas at ``places_m`` (n, 3)."""
        turned = np.einsum("kj,eij->eki", self.weights @ places_m, self.rotation)
        return self.values_m - turned - self.weights.sum(axis=1)[None, :, None] * self.origin_m[:, None, :]


@dataclass(frozen=True, slots=True, eq=False)
class Adjusted:
    """A layout (n, 3) in axes of no meaning. ``information`` (m, m) is of the m free coordinates, ``scores`` (e, m) each instant's part of
    its gradient; ``chi_squares`` (e) with the instant's own ``degrees`` (e), before the layout takes its share.
    """

    places_m: Matrix
    groups: list[Group]
    information: Matrix
    scores: Matrix
    chi_squares: Vector
    degrees: Numbers
    converged: bool


@dataclass(frozen=True, slots=True, eq=False)
class _Eliminated:
    """What a group says of the layout once its own unknowns are out of it."""

    information: Matrix  # (e, m, m)
    score: Matrix  # (e, m)
    own_cov: Matrix  # (e, p, p)
    own_by_layout: Matrix  # (e, p, m)
    own_score: Matrix  # (e, p)


def grouped(instants: Sequence[Measured]) -> list[Group]:
    """Return the instants in groups of the same mixes; rotations and origins are still to be started."""
    found: dict[tuple[bytes, int], list[int]] = defaultdict(list)
    for i, measured in enumerate(instants):
        found[measured.weights.tobytes(), len(measured.weights)].append(i)
    return [_group([instants[i] for i in numbers], np.array(numbers)) for numbers in found.values()]


def _group(members: list[Measured], at: Numbers) -> Group:
    values = np.array([m.values_ned_m for m in members])
    covs = np.array([m.cov_m2 for m in members])
    e = len(at)
    return Group(at, members[0].weights, values, covs, np.tile(np.eye(3), (e, 1, 1)), np.zeros((e, 3)), np.ones(e), np.full(e, np.inf))


def started(group: Group, places_m: Matrix) -> None:
    """Give every instant of a group the rotation and origin that fit best without weights (Kabsch)."""
    body, share = group.weights @ places_m, group.weights.sum(axis=1)
    total = max(float(share @ share), 1e-300) if group.absolute else 1.0
    mean_body, mean_measured = share @ body / total, np.einsum("k,eki->ei", share, group.values_m) / total
    b = body - np.outer(share, mean_body)
    m = group.values_m - share[None, :, None] * mean_measured[:, None, :]
    u, _, vt = np.linalg.svd(np.einsum("eki,kj->eij", m, b))
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    group.rotation = u @ vt
    group.origin_m = mean_measured - np.einsum("eij,j->ei", group.rotation, mean_body) if group.absolute else group.origin_m


def adjusted(instants: Sequence[Measured], start_m: Matrix, basis: Matrix) -> Adjusted:
    """Return the layout that fits all instants.

    ``start_m`` (n, 3): near the answer, in any axes; ``basis`` (3n, m): directions in which the antennas may move, orthonormal.
    """
    places, groups = start_m.copy(), grouped(instants)
    for group in groups:
        started(group, places)
    eliminated, converged = list[_Eliminated](), False
    for _ in range(_STEPS):
        eliminated = [_eliminated(group, places, basis) for group in groups]
        score = np.concatenate([part.score for part in eliminated]).sum(axis=0)
        step: Vector = _inverse(_total(eliminated)) @ score
        moved = max(_moved(group, part, step) for group, part in zip(groups, eliminated, strict=True))
        places = places + (basis @ step).reshape(places.shape)
        if max(moved, float(np.abs(step).max())) < _CONVERGED:
            converged = True
            break
    return _result(places, groups, eliminated, len(instants), converged=converged)


def _total(parts: list[_Eliminated]) -> Matrix:
    return np.concatenate([part.information for part in parts]).sum(axis=0)


def _inverse(normal: Matrix) -> Matrix:
    """Return the pseudo-inverses of normal matrices (..., p, p): zero in what cannot be seen."""
    return np.linalg.pinv(normal, rcond=_UNSEEN, hermitian=True).astype(np.float64)


def _eliminated(group: Group, places: Matrix, basis: Matrix) -> _Eliminated:
    """Return a group's normal equations of the layout, its own unknowns eliminated."""
    own, layout = _jacobians(group, places, basis)
    weight = np.linalg.inv(group.cov_m2)
    residuals = group.residuals_m(places).reshape(len(group.at), -1)
    seen = np.swapaxes(own, 1, 2) @ weight
    own_cov = _inverse(seen @ own)
    across = seen @ layout
    own_score = np.einsum("epk,ek->ep", seen, residuals)
    layout_seen = np.swapaxes(layout, 1, 2) @ weight
    kept = np.swapaxes(across, 1, 2) @ own_cov
    score = np.einsum("emk,ek->em", layout_seen, residuals) - np.einsum("emp,ep->em", kept, own_score)
    return _Eliminated(layout_seen @ layout - kept @ across, score, own_cov, across, own_score)


def _jacobians(group: Group, places: Matrix, basis: Matrix) -> tuple[Matrix, Matrix]:
    """Return the derivatives of the prediction (e, 3k, ...) by the instant's rotation (and origin), and by the layout's free directions."""
    e, k = group.values_m.shape[:2]
    turned = np.einsum("kj,eij->eki", group.weights @ places, group.rotation)
    own = -skews(turned).reshape(e, 3 * k, 3)
    if group.absolute:
        share: Vector = group.weights.sum(axis=1)
        shares = np.einsum("k,ij->kij", share, np.eye(3)).reshape(3 * k, 3)
        own = np.concatenate([own, np.broadcast_to(shares, (e, 3 * k, 3))], axis=2)
    wide = np.einsum("kn,eij->ekinj", group.weights, group.rotation).reshape(e, 3 * k, -1)
    return own, wide @ basis


def _moved(group: Group, part: _Eliminated, step: Vector) -> float:
    """Turn and move the instants of a group as the layout's step wants it; return the largest change.

    Instants with large residuals overshoot, and swing about the answer: their steps are halved when they do not shrink.
    """
    own = np.einsum("epq,eq->ep", part.own_cov, part.own_score - part.own_by_layout @ step)
    turn = np.abs(own[:, :3]).max(axis=1)
    group.step_share = np.where(turn > _SHRINKING * group.last_turn_rad, 0.5, 1.0) * group.step_share
    own, group.last_turn_rad = own * group.step_share[:, None], turn
    group.rotation = rotations_of(own[:, :3]) @ group.rotation
    if group.absolute:
        group.origin_m = group.origin_m + own[:, 3:]
    return float(np.abs(own).max())


def _result(places: Matrix, groups: list[Group], parts: list[_Eliminated], count: int, *, converged: bool) -> Adjusted:
    scores = np.empty((count, len(parts[0].information[0])))
    chi_squares, degrees = np.empty(count), np.empty(count, dtype=np.int64)
    for group, part in zip(groups, parts, strict=True):
        residuals = group.residuals_m(places).reshape(len(group.at), -1)
        scores[group.at] = part.score
        chi_squares[group.at] = np.einsum("ek,ekl,el->e", residuals, np.linalg.inv(group.cov_m2), residuals)
        values = np.linalg.eigvalsh(part.own_cov)
        degrees[group.at] = residuals.shape[1] - np.sum(values > _UNSEEN * values[:, -1:], axis=1)
    return Adjusted(places, groups, _total(parts), scores, chi_squares, degrees, converged)


def axis_scales(found: Adjusted) -> tuple[float, float]:
    """Return the factors, horizontal and vertical, by which the true sigmas of what was measured are larger than the told ones.

    From residuals against what they would be, each by its told variance; NaN where rotations and origins swallow what is measured (heights
    of three antennas).
    """
    sums, expected, told = np.zeros(3), np.zeros(3), np.zeros(3)
    for group in found.groups:
        residuals = group.residuals_m(found.places_m)
        variances = np.einsum("eii->ei", group.cov_m2).reshape(residuals.shape)
        sums += (np.square(residuals) / variances).sum(axis=(0, 1))
        expected += (_left_variances(group, found.places_m).reshape(residuals.shape) / variances).sum(axis=(0, 1))
        told += residuals.shape[0] * residuals.shape[1]
    horizontal = (sums[0] + sums[1]) / max(expected[0] + expected[1], 1e-300)
    vertical = sums[2] / expected[2] if expected[2] > _SWALLOWED * told[2] else np.nan
    return float(np.sqrt(horizontal)), float(np.sqrt(vertical))


def _left_variances(group: Group, places: Matrix) -> Matrix:
    """Return the variances (e, 3k) that residuals have once rotation and origin are fitted."""
    own, _ = _jacobians(group, places, np.zeros((places.size, 0)))
    seen = np.swapaxes(own, 1, 2) @ np.linalg.inv(group.cov_m2) @ own
    return np.einsum("eii->ei", group.cov_m2 - own @ _inverse(seen) @ np.swapaxes(own, 1, 2))


def skews(vectors: Matrix) -> Matrix:
    """Return the cross-product matrices (..., 3, 3) of vectors (..., 3)."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([np.stack([zero, -z, y], -1), np.stack([z, zero, -x], -1), np.stack([-y, x, zero], -1)], -2)


def rotations_of(vectors_rad: Matrix) -> Matrix:
    """Return the rotations (e, 3, 3) about vectors (e, 3) by their lengths: Rodrigues' formula."""
    angle = np.linalg.norm(vectors_rad, axis=1)[:, None, None]
    k = skews(vectors_rad)
    small = angle < 1e-8
    safe = np.where(small, 1.0, angle)
    first, second = np.where(small, 1.0, np.sin(safe) / safe), np.where(small, 0.5, (1.0 - np.cos(safe)) / safe**2)
    return np.eye(3) + first * k + second * (k @ k)
