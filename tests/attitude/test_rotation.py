"""Rotations: closed forms, round trips, derivatives."""

from math import pi

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtkmesh.attitude.rotation import (
    NED_FROM_ENU,
    angles_of,
    angles_per_error,
    quaternion_of,
    rotation_of,
    rotation_of_angles,
    rotation_of_quaternion,
    skew,
    vector_of,
    wrapped,
)

ANGLES = st.tuples(st.floats(0.0, 6.28), st.floats(-1.5, 1.5), st.floats(-3.14, 3.14))
VECTORS = st.tuples(*[st.floats(-1.8, 1.8)] * 3).map(np.array)


def is_rotation(r: np.ndarray) -> bool:
    return np.allclose(r @ r.T, np.eye(3), atol=1e-12) and np.linalg.det(r) == pytest.approx(1.0)


@given(ANGLES)
def test_angles_come_back(angles: tuple[float, float, float]):
    """Heading, pitch and roll of the rotation of heading, pitch and roll."""
    r = rotation_of_angles(*angles)
    assert is_rotation(r)
    found = angles_of(r)
    assert [wrapped(a - b) for a, b in zip(found, angles, strict=True)] == pytest.approx([0.0, 0.0, 0.0], abs=1e-7)


def test_axes_of_simple_attitudes():
    """Heading east points the nose east; nose up raises it; right side down lowers the right wing."""
    assert rotation_of_angles(pi / 2, 0.0, 0.0) @ [1.0, 0.0, 0.0] == pytest.approx([0.0, 1.0, 0.0])
    assert (rotation_of_angles(0.0, 0.3, 0.0) @ [1.0, 0.0, 0.0])[2] < 0.0
    assert (rotation_of_angles(0.0, 0.0, 0.3) @ [0.0, 1.0, 0.0])[2] > 0.0
    assert pytest.approx([2.0, 1.0, -3.0]) == NED_FROM_ENU @ [1.0, 2.0, 3.0]


@given(VECTORS)
def test_vector_and_quaternion_come_back(v: np.ndarray):
    """Logarithm and exponential are inverse below pi, and quaternions keep the rotation."""
    r = rotation_of(v)
    assert is_rotation(r)
    if np.linalg.norm(v) < pi:
        assert vector_of(r) == pytest.approx(v, abs=1e-7)
    q = quaternion_of(r)
    assert q[0] >= 0.0
    assert rotation_of_quaternion(q) == pytest.approx(r, abs=1e-12)


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.6, 0.0, 0.8)])
def test_half_a_turn_has_its_vector(axis: tuple[float, float, float]):
    """Where the trace tells least."""
    v = pi * np.array(axis)
    found = vector_of(rotation_of(v))
    assert np.linalg.norm(found) == pytest.approx(pi)
    assert abs(found @ v) == pytest.approx(pi**2)


@given(VECTORS, VECTORS)
def test_skew_is_the_cross_product(v: np.ndarray, w: np.ndarray):
    assert skew(v) @ w == pytest.approx(np.cross(v, w))


@given(st.tuples(st.floats(0.0, 6.28), st.floats(-1.2, 1.2), st.floats(-3.1, 3.1)), VECTORS)
def test_derivative_of_angles_is_that_of_differences(angles: tuple[float, float, float], v: np.ndarray):
    """A small error in NED changes heading, pitch and roll as the matrix says."""
    r, step = rotation_of_angles(*angles), 1e-6 * v
    ahead, behind = angles_of(rotation_of(step) @ r), angles_of(rotation_of(-step) @ r)
    change = [wrapped(a - b) / 2.0 for a, b in zip(ahead, behind, strict=True)]
    assert change == pytest.approx(angles_per_error(r) @ step, abs=1e-11)


@given(st.floats(-100.0, 100.0))
def test_wrapped_angles_are_in_their_range(angle: float):
    found = wrapped(angle)
    assert -pi < found <= pi
    assert np.cos(found - angle) == pytest.approx(1.0)
