"""Finite numbers in order."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rtkmesh.rtk.ordered import sort_finite


@given(st.lists(st.floats(width=64), max_size=40))
def test_what_is_finite_comes_in_rising_order(values):
    """As numpy's sort gives it, whatever else is among the numbers."""
    given_values, ordered = np.array(values, np.float64), np.full(len(values), -1.0)
    count = sort_finite(given_values, ordered)
    assert ordered[:count].tolist() == sorted(v for v in values if np.isfinite(v))
    assert (ordered[count:] == -1.0).all()
