"""Compiling, or loading from the cache, of the kernels that choose integers."""

from functools import cache

import numpy as np

from rtkmesh.attitude.candidates import Candidates
from rtkmesh.attitude.rigid_body import Layout
from rtkmesh.attitude.search import choose


@cache
def warm_choice() -> None:
    """Choose once among two candidates of two baselines; the second time nothing is left to do."""
    places = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    cov, wrong = 1e-5 * np.eye(3), np.array([0.0, 0.0, 0.2])
    tables = [Candidates(0, end, np.array([places[end], places[end] + wrong]), cov, np.array([1.0, 2.0]), 6) for end in (1, 2)]
    choose(Layout(("a", "b", "c"), places), tables)
