"""The weighted rigid-body fit: the Monte-Carlo tables of seed_systems.md 3.2 and 3.3, closed forms, invariants."""

from math import cos, degrees, pi, radians, sin, sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.attitude.draws import compiled_only

from rtkmesh.attitude.chi_square import chi_square_limit, chi_square_tail
from rtkmesh.attitude.rigid_body import Layout, Measured, Shape, baselines, fit, kabsch, positions, shape_of
from rtkmesh.attitude.rotation import angles_of, rotation_of_angles, rotation_of_quaternion, vector_of, wrapped
from rtkmesh.errors import OptionError

MM = 1e-3
ISO, TALL = (10.0, 10.0, 10.0), (10.0, 10.0, 20.0)


RIGHT_ANGLE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
SQUARE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]])
CUBE_CORNER = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])


def along_x(apex_deg: float) -> np.ndarray:
    """As the reference has them: the first side along the nose."""
    a = radians(apex_deg)
    return np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [cos(a), sin(a), 0.0]])


def layout(places: np.ndarray) -> Layout:
    return Layout(tuple("abcdefgh"[: len(places)]), places)


def noise(antennas: int, sigmas_mm: tuple[float, float, float]) -> np.ndarray:
    return np.kron(np.eye(antennas), np.diag(np.square(np.array(sigmas_mm) * MM)))


def sigmas_deg(cov: np.ndarray) -> list[float]:
    """Return roll, pitch, heading, as the reference's tables."""
    return [degrees(sqrt(cov[i, i])) for i in (2, 1, 0)]


@pytest.mark.parametrize(
    ("places", "sigmas_mm", "roll", "pitch", "heading", "centroid_mm"),
    [
        (RIGHT_ANGLE, ISO, 0.81, 0.81, 0.496, 5.77), (RIGHT_ANGLE, TALL, 1.62, 1.62, 0.496, 5.77),
        (along_x(60.0), ISO, 0.81, 0.81, 0.573, 5.77), (along_x(60.0), TALL, 1.62, 1.62, 0.573, 5.77),
        (along_x(45.0), ISO, 1.02, 0.81, 0.617, 5.77), (along_x(45.0), TALL, 2.04, 1.62, 0.617, 5.77),
        (along_x(120.0), ISO, 1.24, 0.81, 0.444, 5.77), (along_x(120.0), TALL, 2.48, 1.62, 0.444, 5.77),
        (SQUARE, ISO, 0.573, 0.573, 0.405, 5.00), (SQUARE, TALL, 1.146, 1.146, 0.405, 5.00),
        (CUBE_CORNER, ISO, 0.479, 0.479, 0.479, 5.00),
    ],
)  # fmt: skip
def test_sigmas_of_the_reference_layouts(
    places: np.ndarray, sigmas_mm: tuple[float, float, float], roll: float, pitch: float, heading: float, centroid_mm: float
):
    """Level, 3 %: what the Monte Carlo of seed_systems.md 3.2 found."""
    found = fit(layout(places), positions(places, noise(len(places), sigmas_mm)))
    assert found is not None
    assert sorted(sigmas_deg(found.angles_cov_rad2)[:2]) == pytest.approx(sorted([roll, pitch]), rel=0.03)
    assert degrees(sqrt(found.angles_cov_rad2[0, 0])) == pytest.approx(heading, rel=0.03)
    if sigmas_mm == ISO:
        _, cov = found.point(places.mean(axis=0))
        assert sqrt(float(np.trace(cov)) / 3.0) == pytest.approx(centroid_mm * MM, rel=0.03)


@compiled_only
def test_sigmas_are_those_of_draws():
    """Roll 5, pitch -8, heading 40 degrees, 10/10/20 mm: drawn attitudes spread as the covariance says."""
    truth = rotation_of_angles(radians(40.0), radians(-8.0), radians(5.0))
    rng, cov = np.random.default_rng(5), noise(4, TALL)
    expected = fit(layout(SQUARE), positions(SQUARE @ truth.T, cov))
    assert expected is not None
    assert sigmas_deg(expected.angles_cov_rad2) == pytest.approx([1.128, 1.111, 0.417], rel=0.03)
    draws = rng.multivariate_normal((SQUARE @ truth.T).ravel(), cov, 3000).reshape(-1, 4, 3)
    fits = [fit(layout(SQUARE), positions(draw, cov)) for draw in draws]
    errors = np.array([[wrapped(a - b) for a, b in zip(f.angles_rad, angles_of(truth), strict=True)] for f in fits if f is not None])
    assert len(errors) == len(draws)
    assert np.cov(errors.T) == pytest.approx(expected.angles_cov_rad2, rel=0.08, abs=0.04 * float(expected.angles_cov_rad2.max()))
    chi_squares = np.array([f.chi_square for f in fits if f is not None])
    assert chi_squares.mean() == pytest.approx(6.0, rel=0.04)
    assert 0.006 < (chi_squares > chi_square_limit(0.01, 6)).mean() < 0.015


def test_the_right_angle_is_not_optimal_and_74_5_degrees_is():
    """tr C_w = (4 - 2 cos g) / sin(g)^2: 3.732 at 74.5 degrees, 4.000 at 60 and 90 (the paper says 90 is best)."""

    def trace(apex_deg: float) -> float:
        found = fit(layout(along_x(apex_deg)), positions(along_x(apex_deg), noise(3, ISO)))
        assert found is not None
        return float(found.cov[0, 0] + found.cov[1, 1]) / (10.0 * MM) ** 2  # of the normal's direction: level, so x and y

    for apex_deg, expected in ((60.0, 4.0), (74.5, 3.732), (75.0, 3.732), (90.0, 4.0), (120.0, 6.667)):
        closed = (4.0 - 2.0 * cos(radians(apex_deg))) / sin(radians(apex_deg)) ** 2
        assert trace(apex_deg) == pytest.approx(closed, rel=1e-9)
        assert closed == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize(
    ("n", "heading", "tilt"), [(3, 0.468, 1.323), (4, 0.405, 1.146), (5, 0.362, 1.025), (6, 0.331, 0.936), (8, 0.286, 0.810)]
)
def test_antennas_on_a_circle(n: int, heading: float, tilt: float):
    """Radius 0.707 m, 10/10/20 mm: the closed form of the reference."""
    angles = 2.0 * pi * np.arange(n) / n
    places = sqrt(0.5) * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(n)])
    found = fit(layout(places), positions(places, noise(n, TALL)))
    assert found is not None
    assert sigmas_deg(found.angles_cov_rad2) == pytest.approx([tilt, tilt, heading], rel=0.03)


@pytest.mark.parametrize(
    ("factor", "equal", "weighted", "excluded"),
    [
        (3.0, (2.02, 1.93, 0.74), (1.50, 1.40, 0.50), (1.68, 1.60, 0.53)),
        (20.0, (11.2, 10.6, 4.2), (1.63, 1.57, 0.52), (1.67, 1.61, 0.53)),
    ],
)
def test_a_worse_antenna_is_weighted_rather_than_dropped(
    factor: float, equal: tuple[float, ...], weighted: tuple[float, ...], excluded: tuple[float, ...]
):
    """Square, antenna 4 three and twenty times as noisy: the table of seed_systems.md 3.3, which itself is of few draws (6 %)."""
    truth = rotation_of_angles(radians(40.0), radians(-8.0), radians(5.0))
    cov = noise(4, TALL)
    cov[9:, 9:] *= factor**2
    values = SQUARE @ truth.T
    right, dropped = fit(layout(SQUARE), positions(values, cov)), fit(layout(SQUARE), positions(values, cov).without(3))
    assert right is not None
    assert dropped is not None
    assert sigmas_deg(right.angles_cov_rad2) == pytest.approx(weighted, rel=0.06)
    assert sigmas_deg(dropped.angles_cov_rad2) == pytest.approx(excluded, rel=0.06)
    assert spread_deg(SQUARE, truth, cov, ISO) == pytest.approx(equal, rel=0.08)


def spread_deg(places: np.ndarray, truth: np.ndarray, cov: np.ndarray, believed_mm: tuple[float, float, float]) -> list[float]:
    """Return how roll, pitch and heading of draws spread when the fit believes in other sigmas than they have."""
    draws = np.random.default_rng(6).multivariate_normal((places @ truth.T).ravel(), cov, 1500).reshape(-1, len(places), 3)
    fits = [fit(layout(places), positions(draw, noise(len(places), believed_mm))) for draw in draws]
    errors = [[wrapped(a - b) for a, b in zip(f.angles_rad, angles_of(truth), strict=True)] for f in fits if f is not None]
    return sigmas_deg(np.cov(np.array(errors).T))


@compiled_only
def test_a_raised_antenna_counts_for_more_when_heights_are_known_to_be_worse():
    """Cube corner, 10/10/20 mm: the reference's 0.751/0.751/0.499 degrees are of equal weights; true weights give 0.606/0.606/0.489."""
    found = fit(layout(CUBE_CORNER), positions(CUBE_CORNER, noise(4, TALL)))
    assert found is not None
    assert sigmas_deg(found.angles_cov_rad2) == pytest.approx([0.606, 0.606, 0.489], rel=0.01)
    assert spread_deg(CUBE_CORNER, np.eye(3), noise(4, TALL), TALL) == pytest.approx([0.606, 0.606, 0.489], rel=0.06)
    assert spread_deg(CUBE_CORNER, np.eye(3), noise(4, TALL), ISO) == pytest.approx([0.751, 0.751, 0.499], rel=0.06)


def test_a_lost_antenna_costs_less_than_the_papers_rule():
    """Centre of the square from the three that are left: 0.354/0.354/0.503 of the variance of one, not 0.5 of a pair's mean."""
    found = fit(layout(SQUARE), positions(SQUARE, noise(4, ISO)).without(3))
    assert found is not None
    _, cov = found.point(SQUARE.mean(axis=0))
    assert np.diag(cov) / (10.0 * MM) ** 2 == pytest.approx([0.354, 0.354, 0.503], rel=0.06)


PLACES = st.integers(3, 6).flatmap(lambda n: st.tuples(st.just(n), st.integers(0, 10_000)))
ATTITUDES = st.tuples(st.floats(0.0, 6.28), st.floats(-1.4, 1.4), st.floats(-3.1, 3.1))


@given(PLACES, ATTITUDES)
def test_exact_measurements_give_the_exact_rotation(drawn: tuple[int, int], angles: tuple[float, float, float]):
    """Any layout, any attitude, positions and baselines alike; chi-square is zero; the origin is found."""
    n, seed = drawn
    rng = np.random.default_rng(seed)
    places, truth, origin = rng.uniform(-1.0, 1.0, (n, 3)), rotation_of_angles(*angles), np.array([10.0, -20.0, 3.0])
    spread = rng.normal(size=(3 * n, 3 * n)) * 5.0 * MM
    cov = spread @ spread.T + noise(n, ISO)
    by_position = fit(layout(places), positions(origin + places @ truth.T, cov))
    differences = np.hstack([-np.ones((n - 1, 1)), np.eye(n - 1)])
    by_baseline = fit(layout(places), positions(places @ truth.T, cov).mixed(differences))
    assert by_position is not None
    assert by_baseline is not None
    for found in (by_position, by_baseline):
        assert vector_of(found.ned_from_body @ truth.T) == pytest.approx([0.0, 0.0, 0.0], abs=1e-8)
        assert found.chi_square == pytest.approx(0.0, abs=1e-9)
    assert by_position.origin_ned_m == pytest.approx(origin, abs=1e-8)
    assert by_position.degrees == 3 * n - 6
    assert by_baseline.degrees == 3 * (n - 1) - 3
    assert by_baseline.cov == pytest.approx(by_position.cov[:3, :3], rel=1e-6), "a common error of all positions is none of attitude"


@given(st.integers(0, 10_000), ATTITUDES)
def test_noisy_fits_do_not_depend_on_the_form_or_the_order(seed: int, angles: tuple[float, float, float]):
    """Baselines from the first antenna or the second, antennas in another order: the same attitude, covariance and chi-square."""
    rng = np.random.default_rng(seed)
    places, truth = rng.uniform(-1.0, 1.0, (4, 3)), rotation_of_angles(*angles)
    values = places @ truth.T + rng.normal(size=(4, 3)) * 10.0 * MM
    measured = positions(values, noise(4, TALL))
    first = fit(layout(places), measured.mixed(np.array([[-1.0, 1, 0, 0], [-1, 0, 1, 0], [-1, 0, 0, 1]])))
    second = fit(layout(places), measured.mixed(np.array([[1.0, -1, 0, 0], [0, -1, 1, 0], [0, -1, 0, 1]])))
    order = rng.permutation(4)
    reordered = fit(layout(places[order]), positions(values[order], noise(4, TALL)))
    assert first is not None
    assert second is not None
    assert reordered is not None
    for other in (second, reordered):
        assert vector_of(other.ned_from_body @ first.ned_from_body.T) == pytest.approx([0.0] * 3, abs=1e-7)
        assert other.chi_square == pytest.approx(first.chi_square, rel=1e-6, abs=1e-9)
    assert second.cov == pytest.approx(first.cov, rel=1e-6)


@given(st.integers(0, 10_000), ATTITUDES)
def test_the_svd_start_is_horns_quaternion(seed: int, angles: tuple[float, float, float]):
    """Largest eigenvector of Horn's 4x4 matrix, coplanar layouts among them."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(-1.0, 1.0, (4, 3)) * [1.0, 1.0, float(seed % 2)]
    values = places @ rotation_of_angles(*angles).T + rng.normal(size=(4, 3)) * MM
    found = kabsch(places, positions(values, noise(4, ISO)))
    b, m = places - places.mean(axis=0), values - values.mean(axis=0)
    s = b.T @ m
    n = np.empty((4, 4))
    n[0, 0] = np.trace(s)
    n[0, 1:] = n[1:, 0] = [s[1, 2] - s[2, 1], s[2, 0] - s[0, 2], s[0, 1] - s[1, 0]]
    n[1:, 1:] = s + s.T - np.trace(s) * np.eye(3)
    horn = rotation_of_quaternion(np.linalg.eigh(n)[1][:, -1])
    assert found == pytest.approx(horn, abs=1e-8)


def test_shapes_are_said_so():
    """A line, a plane, space; a point has no attitude and two baselines of one direction are a line."""
    assert [shape_of(places) for places in (SQUARE, CUBE_CORNER, SQUARE[:2], np.zeros((2, 3)))] == [
        Shape.PLANE,
        Shape.SPACE,
        Shape.LINE,
        Shape.POINT,
    ]
    line = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.5, 0.0, 0.0]])
    found = fit(layout(line), positions(line @ rotation_of_angles(1.0, 0.2, 0.0).T, noise(3, ISO)))
    assert found is not None
    assert found.shape is Shape.LINE
    assert found.degrees == 9 - 6 + 1
    assert np.isnan(found.angles_cov_rad2).all()
    assert fit(layout(np.zeros((2, 3))), positions(np.zeros((2, 3)), noise(2, ISO))) is None


@given(st.floats(0.0, 6.28), st.floats(-1.2, 1.2), st.floats(-1.0, 1.0))
def test_two_antennas_leave_the_turn_about_their_line_open(heading: float, pitch: float, turn: float):
    """Level without a start, else next to it; sigmas across the line are sigma over length; one degree of freedom: the length."""
    pair = np.array([[0.0, 0.0, 0.0], [1.5, 0.0, 0.0]])
    measured = baselines(((0, 1),), 2, pair[1:] @ rotation_of_angles(heading, pitch, 0.0).T, noise(1, ISO))
    found = fit(layout(pair), measured)
    assert found is not None
    assert [wrapped(a - b) for a, b in zip(found.angles_rad, (heading, pitch, 0.0), strict=True)] == pytest.approx([0.0] * 3, abs=1e-7)
    assert found.degrees == 1
    assert sorted(np.linalg.eigvalsh(found.cov)) == pytest.approx([0.0, (10 * MM / 1.5) ** 2, (10 * MM / 1.5) ** 2], abs=1e-12)
    near = fit(layout(pair), measured, rotation_of_angles(heading, pitch, turn))
    assert near is not None
    assert wrapped(near.angles_rad[2] - turn) == pytest.approx(0.0, abs=1e-6)


def test_an_uncertain_layout_is_in_the_sigmas():
    """An antenna's place known to 10 mm is as good as one measured to 10 mm."""
    exact = fit(layout(SQUARE), positions(SQUARE, 2.0 * noise(4, ISO)))
    both = fit(Layout(tuple("abcd"), SQUARE, noise(4, ISO)), positions(SQUARE, noise(4, ISO)))
    assert exact is not None
    assert both is not None
    assert both.cov == pytest.approx(exact.cov)


def test_without_an_antenna_nothing_of_it_is_left():
    """Also when all baselines begin at it: what is left are the differences."""
    star = baselines(((0, 1), (0, 2), (0, 3)), 4, SQUARE[1:], noise(3, ISO) + 1e-4)
    left = star.without(0)
    assert left.weights.shape == (2, 4)
    assert left.weights[:, 0] == pytest.approx([0.0, 0.0])
    assert left.weights.sum(axis=1) == pytest.approx([0.0, 0.0], abs=1e-12)
    assert left.values_ned_m == pytest.approx(left.weights @ SQUARE)
    assert not left.seen[0]
    assert star.without(3).without(3).weights.shape == (2, 4)


def test_wrong_layouts_are_refused():
    with pytest.raises(OptionError, match="2 different names"):
        Layout(("a", "a"), np.zeros((2, 3)))
    with pytest.raises(OptionError, match="6 by 6"):
        Layout(("a", "b"), np.zeros((2, 3)), np.eye(3))
    assert layout(SQUARE).only(("d", "a")).positions_m == pytest.approx(SQUARE[[3, 0]])


def test_points_of_the_body_without_a_position_are_unknown():
    found = fit(layout(SQUARE), baselines(((0, 1), (0, 2), (0, 3)), 4, SQUARE[1:], noise(3, ISO)))
    assert found is not None
    assert np.isnan(found.point(np.zeros(3))[0]).all()


@pytest.mark.parametrize(
    ("value", "degrees_", "tail"), [(16.8119, 6, 0.01), (3.8415, 1, 0.05), (11.3449, 3, 0.01), (18.3070, 10, 0.05), (5.9915, 2, 0.05)]
)
def test_chi_square_of_the_tables(value: float, degrees_: int, tail: float):
    """Abramowitz and Stegun, table 26.8."""
    assert chi_square_tail(value, degrees_) == pytest.approx(tail, rel=1e-4)
    assert chi_square_limit(tail, degrees_) == pytest.approx(value, rel=2e-5)


def test_measured_without_weights_sees_nothing():
    assert not Measured(np.zeros((1, 3)), np.zeros((1, 3)), np.eye(3)).seen.any()
