"""Compiling, or loading from the cache, of the kernels of an attitude."""

from functools import cache

import numpy as np

from rtkmesh.attitude.candidates import Candidates
from rtkmesh.attitude.integrity import judged
from rtkmesh.attitude.joint import Edge, joint
from rtkmesh.attitude.protection import Guarding, levels
from rtkmesh.attitude.rigid_body import Layout
from rtkmesh.attitude.search import choose

_PLACES = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
_COV_M2 = 1e-5 * np.eye(3)


@cache
def warm_choice() -> None:
    """Choose once among two candidates of two baselines; the second time nothing is left to do."""
    wrong = np.array([0.0, 0.0, 0.2])
    tables = [Candidates(0, end, np.array([_PLACES[end], _PLACES[end] + wrong]), _COV_M2, np.array([1.0, 2.0]), 6) for end in (1, 2)]
    choose(Layout(("a", "b", "c"), _PLACES), tables)


@cache
def warm_body() -> None:
    """Fit and judge two and three antennas once, with levels."""
    layout = Layout(("a", "b", "c"), _PLACES, 1e-6 * np.eye(9))
    edges = [Edge("a", layout.names[end], _PLACES[end], _COV_M2) for end in (1, 2)]
    for some in (edges, edges[:1]):
        measured = joint(layout, some)
        levels(layout, measured, judged(layout, measured), Guarding())
