"""Lengths of baselines that attitudes know: they rank the candidates that a solver tells, which itself need not be told them."""

from collections.abc import Iterator
from itertools import permutations
from math import dist, hypot

from rtkmesh_schemas.config import Deployment
from rtkmesh_schemas.config_attitude import AttitudeTable

_LEAST_SIGMA_M = 0.005  # antennas' phase centres are no better than that

Lengths = dict[tuple[str, str], tuple[float, float]]


def known_lengths(deployment: Deployment) -> Lengths:
    """Return length and sigma (m) between antennas, by their ingests (base, rover), as attitudes that use geometry know them."""
    tables = [table for table in deployment.attitude.values() if table.geometry]
    return {pair: length for table in tables for pair, length in _known(table, deployment)}


def _known(table: AttitudeTable, deployment: Deployment) -> Iterator[tuple[tuple[str, str], tuple[float, float]]]:
    for (start, one), (end, other) in permutations(table.antennas.items(), 2):
        sigma_m = hypot(max(one.sigmas_m), max(other.sigmas_m), _LEAST_SIGMA_M)
        yield (start, end), (dist(one.position_m, other.position_m), sigma_m)
    solver = deployment.solver.get(table.solver)
    if solver is not None and table.length_m is not None:
        yield (solver.base, solver.rover), (table.length_m, table.length_sigma_m)
