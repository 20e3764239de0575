"""What is thrown out before a calibration: distances that are not those of the body, and where it starts.

A wrong integer fix moves one antenna by decimetres: the distances from it differ from their medians over all instants, whatever the
attitude. The antenna of which most of them do is left out of the instant.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude.adjustment import Group, Numbers, grouped
from rtkmesh.attitude.rigid_body import Measured, Shape, kabsch, positions, shape_of
from rtkmesh.errors import OptionError

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Pair = tuple[int, int]

_SPREADS: Final = 6.0  # robust sigmas
_LEAST_M: Final = 0.005  # distances are never screened more tightly
_MAD: Final = 1.4826


@dataclass(frozen=True, slots=True, eq=False)
class Distances:
    """Measured distances of one pair of antennas: numbers of the instants, metres, and the sigmas that were told."""

    at: Numbers = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    length_m: Vector = field(default_factory=lambda: np.empty(0))
    sigma_m: Vector = field(default_factory=lambda: np.empty(0))


def difference(measured: Measured, pair: Pair) -> tuple[Vector, Matrix] | None:
    """Return the vector (3, NED) from one antenna to another with its covariance; None when it was not measured."""
    mix = _mix(measured.weights.tobytes(), measured.weights.shape[1], pair)
    if mix is None:
        return None
    found = measured.mixed(mix[None, :])
    return found.values_ned_m[0], found.cov_m2


@lru_cache(maxsize=4096)
def _mix(weights: bytes, antennas: int, pair: Pair) -> Vector | None:
    """Return the mix of what was measured that is the baseline of a pair, None when there is none."""
    rows = np.frombuffer(weights).reshape(-1, antennas)
    wanted = np.zeros(antennas)
    wanted[pair[0]], wanted[pair[1]] = -1.0, 1.0
    if not len(rows):
        return None
    mix = wanted @ np.linalg.pinv(rows)
    return mix if float(np.abs(mix @ rows - wanted).max()) < 1e-9 else None


def distances(instants: Sequence[Measured], antennas: int) -> dict[Pair, Distances]:
    """Return the measured distances of all pairs of antennas that were measured, in the order of the instants."""
    groups = grouped(instants)
    found = {pair: _distances_of(groups, pair, antennas) for pair in combinations(range(antennas), 2)}
    return {pair: series for pair, series in found.items() if len(series.at)}


def _distances_of(groups: list[Group], pair: Pair, antennas: int) -> Distances:
    parts = list[Distances]()
    for group in groups:
        mix = _mix(group.weights.tobytes(), antennas, pair)
        if mix is not None:
            parts.append(_distances_in(group, mix))
    if not parts:
        return Distances()
    at, length, sigma = (np.concatenate(rows) for rows in zip(*((p.at, p.length_m, p.sigma_m) for p in parts), strict=True))
    order = np.argsort(at)
    return Distances(at[order], length[order], sigma[order])


def _distances_in(group: Group, mix: Vector) -> Distances:
    vectors = np.einsum("k,eki->ei", mix, group.values_m)
    lengths = np.linalg.norm(vectors, axis=1)
    along = np.einsum("k,ei->eki", mix, vectors / np.maximum(lengths, 1e-12)[:, None]).reshape(len(vectors), -1)
    return Distances(group.at, lengths, np.sqrt(np.maximum(np.einsum("ek,ekl,el->e", along, group.cov_m2, along), 0.0)))


def wrong_pairs(found: dict[Pair, Distances]) -> dict[int, list[Pair]]:
    """Return per instant the pairs whose distance is far from the median of all instants."""
    wrong: dict[int, list[Pair]] = {}
    for pair, series in found.items():
        off = np.abs(series.length_m - np.median(series.length_m))
        limit = max(_LEAST_M, _SPREADS * _MAD * float(np.median(off)))
        for k in np.flatnonzero(off > limit):
            wrong.setdefault(int(series.at[k]), []).append(pair)
    return wrong


def without_wrong(measured: Measured, pairs: list[Pair]) -> Measured | None:
    """Return what is left of an instant when the antennas of wrong distances are taken out; None when it cannot be told which."""
    while pairs:
        counts = np.bincount(np.array(pairs).ravel(), minlength=len(measured.seen))
        worst = np.flatnonzero(counts == counts.max())
        if len(worst) > 1:
            return None
        measured = measured.without(int(worst[0]))
        pairs = [pair for pair in pairs if int(worst[0]) not in pair]
    return measured if usable(measured) else None


def usable(measured: Measured) -> bool:
    """Return whether an instant has at least one baseline of the body."""
    seen = np.flatnonzero(measured.seen).tolist()
    return any(difference(measured, pair) is not None for pair in combinations(seen, 2))


def start_places(instants: Sequence[Measured], typical: Sequence[float], names: Sequence[str]) -> Matrix:
    """Return where antennas are (n, 3), roughly, in axes of one instant.

    The most complete instant is taken, the most typical (smallest of ``typical``) among those; the antennas that it lacks come from others
    that share at least three antennas with it. OptionError where nothing ties an antenna to the others.
    """
    order = sorted(range(len(instants)), key=lambda i: (-int(instants[i].seen.sum()), typical[i]))
    places: dict[int, Vector] = {}
    for _ in names:
        before = len(places)
        for i in order:
            _take(places, instants[i])
            if len(places) == len(names):
                found = np.array([places[k] for k in range(len(names))])
                return found - found.mean(axis=0)
        if len(places) == before:
            break
    lost = [name for k, name in enumerate(names) if k not in places]
    raise OptionError(f"nothing ties antenna {', '.join(lost)} to the others: it needs instants with three or more of them")


def _take(places: dict[int, Vector], measured: Measured) -> None:
    """Add the antennas of an instant to those that are placed, by what they have in common."""
    seen = np.flatnonzero(measured.seen).tolist()
    if all(k in places for k in seen) or any(difference(measured, (seen[0], k)) is None for k in seen[1:]):
        return
    here = dict(zip(seen, (np.linalg.pinv(measured.weights) @ measured.values_ned_m)[seen], strict=True))
    if not places:
        places.update(here)
        return
    common = [k for k in seen if k in places]
    if len(common) < 3:
        return
    known, now = np.array([places[k] for k in common]), np.array([here[k] for k in common])
    if shape_of(known) in (Shape.POINT, Shape.LINE):
        return
    turn = kabsch(now, positions(known, np.eye(3 * len(common))))
    for k in seen:
        places.setdefault(k, known.mean(axis=0) + turn @ (here[k] - now.mean(axis=0)))
