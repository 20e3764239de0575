"""Outages of the attitude filter: its sigmas are those of what predictions really go wrong by, for vehicles of any kind."""

from collections.abc import Callable
from math import cos, degrees, nan, pi, radians, sin

import numpy as np
import pytest

from rtkmesh.attitude.filter import AttitudeFilter
from rtkmesh.attitude.filter_options import FilterOptions
from rtkmesh.attitude.rigid_body import Fit, Shape
from rtkmesh.attitude.rotation import rotation_of, rotation_of_angles, vector_of
from rtkmesh.attitude.spread import LAGS_S, NOTHING_SEEN
from rtkmesh.gnss.time import GpsTime

START = GpsTime(2400, 604_760.0)  # the week turns over
SIGMA = radians(0.3)
Attitude = Callable[[float], tuple[float, float, float]]


def swinging(time_s: float) -> tuple[float, float, float]:
    """Roll of 6 deg with a period of 3 s."""
    return 1.0, 0.0, radians(6.0) * sin(2.0 * pi * time_s / 3.0)


def steady(time_s: float) -> tuple[float, float, float]:
    """Three degrees a second, level."""
    return radians(3.0) * time_s, 0.0, 0.0


def squares(attitude: Attitude, outage_s: float, runs: int) -> list[float]:
    """Squared errors in units of their covariance, per degree of freedom, at the ends of outages after 15 s at 10 Hz, four a run."""
    found: list[float] = []
    for run in range(runs):
        rng, filtered = np.random.default_rng(run), AttitudeFilter(FilterOptions(max_heading_sigma_rad=pi))
        shift_s = rng.uniform(0.0, 300.0)
        for k in range(round(40.0 * (15.0 + outage_s))):
            truth = rotation_of_angles(*attitude(shift_s + 0.1 * k))
            phase_s = 0.1 * k % (15.0 + outage_s)
            if phase_s < 15.0 - 1e-6:
                filtered.rotation(START + 0.1 * k, whole(rotation_of(SIGMA * rng.standard_normal(3)) @ truth))
            elif phase_s > 14.9 + outage_s - 1e-6:
                estimate = filtered.predicted(START + 0.1 * k)
                assert estimate.ned_from_body is not None, estimate.why
                error = vector_of(truth @ estimate.ned_from_body.T)
                found.append(float(error @ np.linalg.solve(estimate.cov_rad2, error)) / 3.0)
    return found


def whole(rotation: np.ndarray) -> Fit:
    return Fit(rotation, SIGMA**2 * np.eye(3), np.full(3, nan), np.zeros((1, 3)), 0.0, 3, Shape.SPACE)


@pytest.mark.parametrize("attitude", [swinging, steady])
@pytest.mark.parametrize("outage_s", [1.0, 2.0])
def test_sigmas_of_outages_are_honest(attitude: Attitude, outage_s: float) -> None:
    """Without what is learned of past predictions the mean is 2.4 (swinging, 1 s), 0.2 to 0.3 (steady)."""
    assert 0.5 < np.mean(squares(attitude, outage_s, 3)) < 1.5


def test_what_was_seen_is_what_comes() -> None:
    """Many predictions over a second that went wrong by 2 deg: the next one's variance is that, over half a second the model's."""
    rates, ties, walk = np.full(3, 1e-4), np.zeros(3), 1e-5
    model = rates + walk / 3.0
    spread = NOTHING_SEEN
    for _ in range(500):
        spread = spread.faded(0.1, rates).with_squares(LAGS_S.index(1.0), np.full(3, radians(2.0) ** 2), model, np.ones(3))
    factors = spread.over(1.0, rates, ties, walk, np.zeros(3))
    assert factors is not None
    assert factors * model == pytest.approx(np.full(3, radians(2.0) ** 2), rel=0.01)
    assert spread.over(0.5, rates, ties, walk, np.zeros(3)) == pytest.approx(np.ones(3), rel=1e-6)
    assert spread.over(0.1, rates, ties, walk, np.zeros(3)) is None
    assert NOTHING_SEEN.over(1.0, rates, ties, walk, np.zeros(3)) is None


def test_ties_of_angle_and_rate_count() -> None:
    """f own + sqrt(f) tied is what was seen."""
    rates, ties, walk = np.full(3, 1e-4), np.full(3, 5e-5), 1e-5
    spread = NOTHING_SEEN
    own, tied = rates * 4.0 + walk * 8.0 / 3.0, 4.0 * ties
    for _ in range(500):
        spread = spread.faded(0.1, rates).with_squares(LAGS_S.index(2.0), np.full(3, 1e-3), own + tied, np.ones(3))
    factors = spread.over(2.0, rates, ties, walk, np.zeros(3))
    assert factors is not None
    assert factors * own + np.sqrt(factors) * tied == pytest.approx(np.full(3, 1e-3), rel=0.01)


def test_a_turn_that_begins_between_two_fixes_is_followed() -> None:
    """Straight for a minute at 1 Hz, then 90 degrees in 4 s: it may be gated once, and its sigmas say so; never a reset."""
    filtered, rng = AttitudeFilter(FilterOptions()), np.random.default_rng(1)
    for k in range(80):
        part = min(max((k - 60) / 4.0, 0.0), 1.0)
        truth = rotation_of_angles(0.25 * pi * (1.0 - cos(pi * part)), 0.0, 0.0)
        filtered.rotation(START + float(k), whole(rotation_of(SIGMA * rng.standard_normal(3)) @ truth))
        estimate = filtered.predicted(START + float(k))
        if estimate.ned_from_body is not None:
            error = degrees(float(vector_of(truth @ estimate.ned_from_body.T)[2]))
            assert abs(error) < 3.5 * degrees(float(estimate.cov_rad2[2, 2]) ** 0.5)
    assert filtered.resets == 0
