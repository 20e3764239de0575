"""All edges of an epoch as one measurement: what receivers share is modelled, and what fits say of it is so."""

from math import degrees, pi, radians, sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.attitude.draws import compiled_only

from rtkmesh.attitude.joint import Edge, angles_covariance, heading_edge, joint, made_positive, point_of, receiver_variances
from rtkmesh.attitude.rigid_body import Layout, Shape, fit
from rtkmesh.attitude.rotation import angles_per_error, rotation_of_angles, vector_of, wrapped

ANTENNAS = Layout(("a", "b", "c"), np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 1.2, 0.0]]))
TRUTH = rotation_of_angles(radians(200.0), radians(4.0), radians(-7.0))
SIGMAS_M = np.array([0.004, 0.004, 0.008])
ONE = np.diag(SIGMAS_M**2)
BASE = np.diag(np.array([0.006, 0.006, 0.012]) ** 2)


def edges_of(errors: dict[str, np.ndarray], covs: dict[str, np.ndarray], pairs: list[tuple[str, str]]) -> list[Edge]:
    """Return what pairs measure when every receiver has its error; the base is at NED 0."""
    true = {"base": np.zeros(3), **dict(zip(ANTENNAS.names, ANTENNAS.positions_m @ TRUTH.T + 50.0, strict=True))}
    said = {name: true[name] + errors[name] for name in errors}
    return [Edge(start, end, said[end] - said[start], covs[start] + covs[end]) for start, end in pairs]


def test_variances_of_receivers_add_up_to_those_of_the_edges():
    """A triangle tells them all; a star leaves one open, which is shared."""
    variances = np.array([ONE, 4.0 * ONE, 9.0 * ONE])
    triangle = np.array([[1.0, 1.0, 0.0], [1.0, 0.0, 1.0], [0.0, 1.0, 1.0]])
    found = receiver_variances(triangle, np.einsum("km,mab->kab", triangle, variances))
    np.testing.assert_allclose(found, variances, atol=1e-12)
    star = np.array([[1.0, 1.0, 0.0], [1.0, 0.0, 1.0]])
    np.testing.assert_allclose(receiver_variances(star, np.array([2.0 * ONE, 2.0 * ONE])), [ONE, ONE, ONE], atol=1e-12)


@given(st.lists(st.floats(1e-6, 1e2), min_size=3, max_size=3))
def test_the_joint_covariance_is_positive_whatever_the_edges_say(scales: list[float]):
    """Edges of a triangle that contradict each other's variances."""
    pairs = [("a", "b"), ("a", "c"), ("b", "c")]
    edges = [Edge(*pair, np.zeros(3), scale * ONE) for pair, scale in zip(pairs, scales, strict=True)]
    values = np.linalg.eigvalsh(joint(ANTENNAS, edges).cov_m2)
    assert values[0] > 0.0


def test_two_baselines_of_one_receiver_are_correlated():
    """Its error is in both, with the same sign where both start there."""
    edges = edges_of(dict.fromkeys("abc", np.zeros(3)), dict.fromkeys("abc", ONE), [("a", "b"), ("a", "c")])
    measured = joint(ANTENNAS, edges)
    np.testing.assert_allclose(measured.cov_m2[:3, 3:], ONE, atol=1e-15)
    np.testing.assert_allclose(measured.weights, [[-1, 1, 0], [-1, 0, 1]])


def test_baselines_of_a_triangle_share_three_quarters_of_what_their_antennas_do():
    """The rest is their own; a position with a base of its own shares with none but those of its antenna."""
    edges = [Edge(*pair, np.zeros(3), ONE) for pair in (("a", "b"), ("a", "c"), ("b", "c"), ("its base", "a"))]
    found = joint(ANTENNAS, edges)
    assert found.cov_m2[0, 3] == pytest.approx(0.375 * ONE[0, 0])
    assert found.cov_m2[0, 6] == pytest.approx(-0.375 * ONE[0, 0])
    assert found.cov_m2[9, 6] == pytest.approx(0.0, abs=1e-12)
    assert np.diag(found.cov_m2) == pytest.approx(np.tile(np.diag(ONE), 4))
    assert found.weights.tolist() == [[-1.0, 1.0, 0.0], [-1.0, 0.0, 1.0], [0.0, -1.0, 1.0], [1.0, 0.0, 0.0]]


def test_covariances_that_rounding_spoilt_are_made_positive():
    spoilt = np.array([[1.0, 1.1, 0.0], [1.1, 1.0, 0.0], [0.0, 0.0, 0.0]]) * 1e-6
    assert np.linalg.eigvalsh(made_positive(spoilt))[0] == pytest.approx(1e-8)
    np.testing.assert_allclose(made_positive(ONE), ONE, rtol=1e-12)


@pytest.mark.parametrize(
    "pairs",
    [
        [("a", "b"), ("a", "c")],
        [("base", "a"), ("base", "b"), ("base", "c")],
        [("base", "a"), ("a", "b"), ("a", "c")],
    ],
)
@compiled_only
def test_sigmas_are_those_of_draws(pairs: list[tuple[str, str]]):
    """Attitude (and chi-square) of 1500 draws in which receivers and the base have errors of their own."""
    generator = np.random.default_rng(7)
    covs = {"base": ONE, **dict.fromkeys("abc", ONE)}
    nees, chi = [], []
    for _ in range(1500):
        errors = {name: generator.multivariate_normal(np.zeros(3), cov) for name, cov in covs.items()}
        found = fit(ANTENNAS, joint(ANTENNAS, edges_of(errors, covs, pairs)))
        assert found is not None
        off = vector_of(TRUTH @ found.ned_from_body.T)
        nees.append(off @ np.linalg.solve(found.cov[:3, :3], off))
        chi.append(found.chi_square / found.degrees)
    assert np.mean(nees) == pytest.approx(3.0, rel=0.1)
    assert np.mean(chi) == pytest.approx(1.0, rel=0.1)


def test_a_bases_error_is_in_the_position_and_does_not_average_out():
    """With exact antennas the position is as good as the base, the attitude exact."""
    tiny = 1e-8 * ONE
    covs = {"base": BASE, **dict.fromkeys("abc", tiny)}
    edges = edges_of({name: np.zeros(3) for name in covs}, covs, [("base", "a"), ("base", "b"), ("base", "c"), ("a", "b"), ("a", "c")])
    found = fit(ANTENNAS, joint(ANTENNAS, edges))
    assert found is not None
    assert np.diag(found.point(np.zeros(3))[1])[0] > 0.3 * BASE[0, 0]


def test_a_heading_says_what_it_says():
    """Along one line: heading and pitch with their sigmas; the length of it nothing, the roll not at all."""
    line = Layout(("from", "to"), np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))
    sigmas = radians(0.2), radians(0.5)
    found = fit(line, joint(line, [heading_edge(("from", "to"), (radians(359.5), radians(10.0)), sigmas, 1.0, None)]))
    assert found is not None
    heading, pitch, roll = found.angles_rad
    assert degrees(wrapped(heading)) == pytest.approx(-0.5, abs=1e-6)
    assert (degrees(pitch), degrees(roll)) == pytest.approx((10.0, 0.0), abs=1e-6)
    cov = angles_covariance(found, radians(10.0))
    assert np.sqrt(np.diag(cov))[:2] == pytest.approx(sigmas, rel=1e-3)
    assert np.isnan(cov[2]).all()


@pytest.mark.parametrize(("azimuth", "seen"), [(0.0, [0, 1]), (pi / 2.0, [0, 2]), (radians(40.0), [0])])
def test_a_line_of_antennas_says_which_angles_it_sees(azimuth: float, seen: list[int]):
    """Along the nose not roll, across it not pitch, between both neither of them alone."""
    line = Layout(("a", "b"), np.array([[0.0, 0.0, 0.0], [np.cos(azimuth), np.sin(azimuth), 0.0]]))
    found = fit(line, joint(line, [Edge("a", "b", line.positions_m[1], ONE)]))
    assert found is not None
    assert found.shape is Shape.LINE
    assert np.flatnonzero(np.isfinite(np.diag(angles_covariance(found, radians(10.0))))).tolist() == seen


def test_the_unseen_tilt_is_in_the_sigmas_of_a_line_that_is_not_level():
    """A body that rolls about a diagonal line: the heading of a tilted line is off by what the tilt does to it."""
    azimuth, tilt = radians(45.0), radians(8.0)
    direction = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    line = Layout(("a", "b"), np.array([np.zeros(3), direction]))
    turned = rotation_of_angles(0.0, radians(10.0), 0.0)
    found = fit(line, joint(line, [Edge("a", "b", turned @ direction, 1e-8 * ONE)]))
    assert found is not None
    sigma = sqrt(angles_covariance(found, tilt)[0, 0])
    unseen = angles_per_error(found.ned_from_body)[0] @ (turned @ direction)
    assert sigma == pytest.approx(abs(unseen) * tilt, rel=0.05)
    assert abs(wrapped(found.angles_rad[0])) < 2.0 * sigma


def test_points_off_a_line_have_the_unseen_turn_in_their_covariance():
    """A point one metre beside a line of two positions, 10 degrees of roll: 17 cm of height."""
    line = Layout(("a", "b"), np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))
    edges = [Edge("base", name, place, 2.0 * ONE) for name, place in zip(line.names, line.positions_m, strict=True)]
    found = fit(line, joint(line, edges))
    assert found is not None
    place, cov = point_of(found, np.array([0.5, 1.0, 0.0]), radians(10.0))
    np.testing.assert_allclose(place, [0.5, 1.0, 0.0], atol=1e-9)
    assert sqrt(cov[2, 2]) == pytest.approx(radians(10.0), rel=0.02)
