"""Solutions of one epoch, with a satellite left out: against dense least squares, and where the answer is known by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtkmesh.rtk.separation import (
    CLOCK,
    COLUMNS,
    RANGE,
    Ranges,
    Rest,
    _take_clocks,
    horizontal_sigma,
    leave_out,
    normalised_square,
    solve_epoch,
)


def ranges_of(directions: np.ndarray, value_m: np.ndarray, sigma_m: np.ndarray, group: list[int], satellite: list[int]) -> Ranges:
    rows = np.ones((len(value_m), COLUMNS))
    rows[:, :3], rows[:, RANGE], rows[:, CLOCK] = -directions, value_m, 1.0
    return Ranges(rows, 1.0 / sigma_m**2, np.array(group, np.int64), np.array(satellite, np.int16), max(group) + 1)


def new_rest() -> Rest:
    """Room for what is left."""
    return Rest(np.empty(3), np.empty((3, 3)), np.empty((CLOCK, CLOCK)), np.empty((COLUMNS, COLUMNS)))


def sky(rng: np.random.Generator, satellites: int, bands: int = 1) -> np.ndarray:
    """Directions of satellites above the horizon, each as often as it has bands."""
    enu = rng.normal(size=(satellites, 3))
    enu[:, 2] = abs(enu[:, 2]) + 0.1
    return np.repeat(enu / np.linalg.norm(enu, axis=1)[:, None], bands, axis=0)


def random_ranges(seed: int, satellites: int = 9) -> Ranges:
    """Two bands of satellites of two systems."""
    rng = np.random.default_rng(seed)
    group = [2 * (s % 2) + band for s in range(satellites) for band in range(2)]
    values, sigmas = rng.normal(size=2 * satellites), rng.uniform(0.5, 2.0, 2 * satellites)
    return ranges_of(sky(rng, satellites, 2), values, sigmas, group, [s for s in range(satellites) for _ in range(2)])


def dense(ranges: Ranges, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Place, covariance and chi-square by least squares with every clock as an unknown."""
    groups = np.unique(ranges.group[rows])
    A = np.hstack([ranges.rows[rows, :3], (ranges.group[rows][:, None] == groups).astype(float)])
    w = ranges.weight[rows]
    Q = np.linalg.inv(A.T @ (w[:, None] * A))
    x = Q @ A.T @ (w * ranges.rows[rows, RANGE])
    residual = ranges.rows[rows, RANGE] - A @ x
    return x[:3], Q[:3, :3], float(residual @ (w * residual))


@pytest.mark.parametrize("seed", range(4))
def test_an_epoch_is_least_squares_with_a_clock_per_group(seed: int):
    """Eliminating clocks changes nothing."""
    ranges = random_ranges(seed)
    found = solve_epoch(ranges)
    place, cov, chi2 = dense(ranges, np.arange(18))
    assert found.solved
    assert found.dof == 18 - 4 - 3
    np.testing.assert_allclose(found.place, place, atol=1e-10)
    np.testing.assert_allclose(found.cov, cov, atol=1e-10)
    assert found.chi2 == pytest.approx(chi2)


@pytest.mark.parametrize("seed", range(4))
def test_leaving_a_satellite_out_is_solving_without_it(seed: int):
    """Both of its bands go, also where it was the only one of a group."""
    ranges = random_ranges(seed)
    ranges.group[4] = 4
    ranges = ranges._replace(groups=5)
    whole, rest = solve_epoch(ranges), new_rest()
    for s in range(9):
        assert leave_out(ranges, whole, 2 * s, 2 * s + 2, rest)
        expected = dense(ranges, np.flatnonzero(ranges.satellite != s))
        np.testing.assert_allclose(rest.place, expected[0], atol=1e-8)
        np.testing.assert_allclose(rest.cov, expected[1], atol=1e-8)


def test_clocks_of_a_thousand_kilometres_leave_the_millimetres():
    """The first range of a group is taken from all of it before anything is squared."""
    near = random_ranges(1)
    far = near._replace(rows=near.rows.copy())
    far.rows[:, RANGE] += np.array([2.6e6, -3.1e6, 1.4e6, 5e5])[far.group]
    _take_clocks(far)
    first, second = solve_epoch(near), solve_epoch(far)
    np.testing.assert_allclose(second.place, first.place, atol=1e-8)
    assert second.chi2 == pytest.approx(first.chi2, rel=1e-6)


def cross(value_m: np.ndarray, sigma_m: float) -> Ranges:
    """North, east, south and west at the horizon, and the zenith: one redundancy, which no clock or place can hide."""
    directions = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return ranges_of(directions, value_m, np.full(5, sigma_m), [0] * 5, list(range(5)))


@pytest.mark.parametrize(("satellite", "redundancy"), [(0, 0.25), (1, 0.25), (2, 0.25), (3, 0.25), (4, 0.0)])
def test_what_a_bias_adds_to_the_residuals_is_its_redundancy(satellite: int, redundancy: float):
    """The parity vector of the cross is (1, -1, 1, -1, 0) / 2, so a bias b of one range at the horizon adds b^2 / (4 sigma^2), and its
    minimal detectable bias (Baarda 1968; Teunissen 2006, Testing Theory) is 2 sigma sqrt(lambda). The zenith has none.
    """
    bias = np.zeros(5)
    bias[satellite] = 3.0
    found = solve_epoch(cross(bias, 0.5))
    assert found.dof == 1
    assert found.chi2 == pytest.approx(redundancy * 9.0 / 0.25, abs=1e-9)


def test_a_bias_does_not_touch_the_solution_without_its_satellite():
    """And the separation is the bias times its gain: half of it for a range of the cross towards its own side."""
    bias = np.array([3.0, 0.0, 0.0, 0.0, 0.0])
    ranges = cross(bias, 0.5)
    whole, rest = solve_epoch(ranges), new_rest()
    assert leave_out(ranges, whole, 0, 1, rest)
    np.testing.assert_allclose(rest.place, 0.0, atol=1e-12)
    assert whole.place[1] == pytest.approx(-1.5)
    assert not leave_out(ranges, whole, 4, 5, rest)  # nothing else sees the height


@given(st.integers(0, 1000), st.integers(5, 10))
def test_another_satellite_never_makes_it_worse(seed: int, satellites: int):
    """More ranges of known clocks never raise a sigma."""
    rng = np.random.default_rng(seed)
    directions, sigma = sky(rng, satellites), rng.uniform(0.5, 2.0, satellites)
    fewer, all_ = (
        solve_epoch(ranges_of(directions[:n], np.zeros(n), sigma[:n], [0] * n, list(range(n)))) for n in (satellites - 1, satellites)
    )
    if fewer.solved:
        assert horizontal_sigma(all_.cov) <= horizontal_sigma(fewer.cov) * (1.0 + 1e-9)
        assert all_.cov[2, 2] <= fewer.cov[2, 2] * (1.0 + 1e-9)


@given(st.integers(0, 1000))
def test_the_largest_horizontal_sigma_is_that_of_no_other_direction(seed: int):
    """It is the root of the larger eigenvalue."""
    root = np.random.default_rng(seed).normal(size=(3, 3))
    cov = root @ root.T
    assert horizontal_sigma(cov) == pytest.approx(np.sqrt(np.linalg.eigvalsh(cov[:2, :2])[1]))


def test_normalised_squares():
    """By a solver, and infinite of what has no variance."""
    root = np.random.default_rng(3).normal(size=(3, 3))
    cov, d = root @ root.T, np.array([1.0, -2.0, 0.5])
    assert normalised_square(d, cov) == pytest.approx(d @ np.linalg.solve(cov, d))
    assert normalised_square(d, np.zeros((3, 3))) == np.inf
