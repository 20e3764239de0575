"""The joint covariance of a layout, block by block, as files have it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtkmesh.attitude.layout_covariance import blocks_of, joint_covariance
from rtkmesh.attitude.rigid_body import Layout

NAMES = ("a", "b", "c")


def layout(seed: int) -> Layout:
    root = np.random.default_rng(seed).normal(0.0, 1e-3, (9, 9))
    root[:3] = 0.0  # the origin is exact
    return Layout(NAMES, np.arange(9.0).reshape(3, 3), root @ root.T)


@given(st.integers(0, 1000), st.permutations(NAMES))
def test_blocks_make_the_covariance_again_in_any_order(seed: int, order: list[str]):
    """What was written by one order of antennas is read by another."""
    known, blocks = layout(seed), blocks_of(layout(seed))
    found = joint_covariance(dict.fromkeys(order, (1.0, 1.0, 1.0)), blocks)
    expected = known.only(tuple(order)).cov_m2
    assert found is not None
    assert expected is not None
    np.testing.assert_allclose(found, expected, atol=1e-15)


def test_an_antenna_without_blocks_has_its_sigmas_and_shares_nothing():
    """As one whose place the deployment file says itself, instead of the layout's."""
    known, blocks = layout(1), blocks_of(layout(1))
    del blocks["b"]
    found = joint_covariance(dict.fromkeys(NAMES, (0.01, 0.02, 0.03)), blocks)
    assert found is not None
    assert known.cov_m2 is not None
    np.testing.assert_allclose(found[3:6, 3:6], np.diag([1e-4, 4e-4, 9e-4]))
    assert not found[3:6, 6:].any()
    np.testing.assert_allclose(found[6:, 6:], known.cov_m2[6:, 6:], atol=1e-15)


def test_what_rounding_made_negative_is_made_zero():
    one, other = 1e-6 * np.eye(3), 1.001e-6 * np.eye(3)
    blocks = {"a": {"a": tuple(one.ravel())}, "b": {"b": tuple(one.ravel()), "a": tuple(other.ravel())}}
    found = joint_covariance(dict.fromkeys("ab", (0.0, 0.0, 0.0)), blocks)
    assert found is not None
    assert np.linalg.eigvalsh(found)[0] > -1e-18
    assert found[0, 0] == pytest.approx(1e-6, rel=2e-3)


def test_exact_places_have_none():
    assert joint_covariance(dict.fromkeys(NAMES, (0.0, 0.0, 0.0)), {}) is None
    assert blocks_of(Layout(NAMES, np.arange(9.0).reshape(3, 3))) == {}
