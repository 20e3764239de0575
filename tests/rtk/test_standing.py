"""Where a rover stands: the mean of its fixes, its covariance, and what is another place."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.standing import LASTING, LASTS_S, STRAYS, Standing

START = GpsTime(2445, 604000.0)  # the week ends in between
BASE = np.array([4e6, 3e5, 5e6])
TRUE = np.array([100.0, -200.0, 30.0])
EAST = np.array([1.0, 0.0, 0.0])


def placed(
    errors_m: np.ndarray, sigma_m: float, step_s: float = 1.0, standing: Standing | None = None
) -> list[tuple[np.ndarray, np.ndarray]]:
    standing, cov = standing or Standing(), sigma_m**2 * np.eye(3)
    return [standing.place(START + k * step_s, BASE, TRUE + error, cov) for k, error in enumerate(errors_m)]


def multipath_m(rng: np.random.Generator, seconds: int, sigma_m: float) -> np.ndarray:
    """Return a Gauss-Markov process (seconds, 3) of the time constant that is meant."""
    keep, out = np.exp(-1.0 / LASTS_S), np.empty((seconds, 3))
    out[0] = sigma_m * rng.standard_normal(3)
    for k in range(1, seconds):
        out[k] = keep * out[k - 1] + sigma_m * np.sqrt(1.0 - keep**2) * rng.standard_normal(3)
    return out


def test_the_first_fix_is_as_it_is_and_the_mean_is_surer_with_time():
    found = placed(np.zeros((1800, 3)), 0.01)
    assert np.array_equal(found[0][0], TRUE)
    assert np.array_equal(found[0][1], 1e-4 * np.eye(3))
    traces = [np.trace(cov) for _, cov in found]
    assert np.all(np.diff(traces) < 0.0)
    assert traces[-1] == pytest.approx(3e-4 * (LASTING + (1.0 - LASTING) / (1.0 + 1800.0 / (2.0 * LASTS_S))), rel=1e-2)


@pytest.mark.parametrize("seconds", [60, 600, 2400])
def test_means_of_multipath_are_as_sure_as_they_say(seconds: int):
    """Of what does not last for ever; the share that does is beside it."""
    rng, squares = np.random.default_rng(1), list[float]()
    for _ in range(60):
        place, cov = placed(multipath_m(rng, seconds, 0.01), 0.01)[-1]
        squares.append(float((place - TRUE) @ np.linalg.solve(cov, place - TRUE)) / 3.0)
    assert 0.1 < np.mean(squares) < 1.2


@given(step_s=st.sampled_from([0.1, 1.0, 5.0, 30.0]))
def test_how_often_there_are_fixes_hardly_matters(step_s: float):
    """Half an hour of them."""
    found = placed(np.zeros((int(1800.0 / step_s) + 1, 3)), 0.01, step_s)
    assert np.trace(found[-1][1]) == pytest.approx(np.trace(placed(np.zeros((1801, 3)), 0.01)[-1][1]), rel=0.02)


def test_a_weak_fix_moves_the_mean_by_little():
    standing = Standing()
    placed(np.zeros((300, 3)), 0.008, standing=standing)
    place, cov = standing.place(START + 300.0, BASE, TRUE + 0.1 * EAST, 0.06**2 * np.eye(3))
    assert np.linalg.norm(place - TRUE) < 1e-3
    assert np.sqrt(np.trace(cov)) < 0.012


def test_one_fix_of_another_place_counts_by_itself_and_more_begin_anew():
    standing, other, cov = Standing(), TRUE + 0.19 * EAST, 1e-4 * np.eye(3)
    placed(np.zeros((100, 3)), 0.01, standing=standing)
    assert np.array_equal(standing.place(START + 100.0, BASE, other, cov)[0], other)
    assert standing.place(START + 101.0, BASE, TRUE, cov)[0] == pytest.approx(TRUE, abs=1e-9)
    for k in range(STRAYS):
        assert np.array_equal(standing.place(START + 102.0 + k, BASE, other, cov)[0], other)
    assert standing.place(START + 110.0, BASE, other + 0.005 * EAST, cov)[0] == pytest.approx(other, abs=5e-3)


def test_another_position_of_the_base_begins_anew():
    standing, cov = Standing(), 1e-4 * np.eye(3)
    placed(np.zeros((100, 3)), 0.01, standing=standing)
    place, told = standing.place(START + 100.0, BASE + 0.01 * EAST, TRUE - 0.01 * EAST, cov)
    assert np.array_equal(place, TRUE - 0.01 * EAST)
    assert np.array_equal(told, cov)


def test_times_may_fall():
    """Backward, and a fix that is repeated adds nothing."""
    standing, cov = Standing(), 1e-4 * np.eye(3)
    last = [standing.place(START + -float(k), BASE, TRUE, cov) for k in range(300)][-1][1]
    assert np.trace(last) == pytest.approx(np.trace(placed(np.zeros((300, 3)), 0.01)[-1][1]), rel=1e-6)
    assert np.trace(standing.place(START + -299.0, BASE, TRUE, cov)[1]) == pytest.approx(np.trace(last), rel=1e-9)


@pytest.mark.parametrize("cov", [np.full((3, 3), np.nan), np.zeros((3, 3)), np.diag([1.0, 1.0, np.inf])])
def test_a_covariance_that_is_none_does_no_harm(cov: np.ndarray):
    standing = Standing()
    placed(np.zeros((10, 3)), 0.01, standing=standing)
    place, told = standing.place(START + 10.0, BASE, TRUE + EAST, cov)
    assert np.array_equal(place, TRUE + EAST)
    assert np.array_equal(told, cov, equal_nan=True)
    place, told = standing.place(START + 11.0, BASE, TRUE, 1e-4 * np.eye(3))
    assert place == pytest.approx(TRUE)
    assert np.isfinite(told).all()
