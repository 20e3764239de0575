"""How good Doppler velocities are said to be: closed forms, drawn range rates, and the sum of a base's velocity and a relative one."""

from math import nan
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rtkmesh.gnss.time import GpsTime
from rtkmesh.models.single_adjustment import QUALITY, RATE_CHI2, RATE_FREEDOM
from rtkmesh.rtk.rate_errors import EPOCH_PRIOR_DOF, MEMORY_DOF, PRIOR_DOF, RateErrors
from rtkmesh.rtk.report import covariance_of_sum

START = GpsTime(2400, 3600.0)


def quality(squares: float, freedom: float) -> NDArray[np.float64]:
    """What an adjustment tells of its range rates."""
    told = np.full(QUALITY, nan)
    told[RATE_CHI2], told[RATE_FREEDOM] = squares, freedom
    return told


def learned(factor: float, epochs: int, step_s: float = 1.0, seed: int = 1) -> RateErrors:
    """Errors of a receiver whose range rates have ``factor`` times the variance of their weights."""
    rates, rng = RateErrors(), np.random.default_rng(seed)
    for k in range(epochs):
        rates.learn(START + k * step_s, quality(factor * rng.chisquare(8), 8.0))
    return rates


@pytest.mark.parametrize("factor", [0.006, 0.1, 0.8])
def test_the_factor_is_that_of_the_residuals(factor: float):
    """Drawn for less than a hundredth of the variance it is found within two minutes."""
    found = [learned(factor, 120, seed=seed).factor for seed in range(50)]
    assert np.median(found) == pytest.approx(factor, rel=0.2)


def test_without_velocity_the_factor_says_nothing():
    """And what was known stays known."""
    rates = learned(0.01, 100)
    rates.learn(START + 100.0, quality(nan, nan))
    assert rates.factor == 1.0
    rates.learn(START + 101.0, quality(0.08, 8.0))
    assert rates.factor == pytest.approx(0.01, rel=0.3)


def test_four_satellites_are_as_good_as_the_others_were():
    """No degree of freedom: what is remembered stands."""
    rates = learned(0.01, 100)
    rates.learn(START + 100.0, quality(0.0, 0.0))
    assert rates.factor == pytest.approx(0.01, rel=0.3)


def test_an_epoch_with_large_residuals_is_unsure_at_once():
    """Its covariance has its own variance of unit weight in it where that exceeds 1; the factor takes care of the rest."""
    rates = learned(0.01, 100)
    rates.learn(START + 100.0, quality(80.0, 8.0))
    whole = rates.factor * 80.0 / 8.0
    remembered = 0.01
    assert whole == pytest.approx((EPOCH_PRIOR_DOF * remembered + 80.0) / (EPOCH_PRIOR_DOF + 8.0), rel=0.01)


def test_epochs_of_a_second_teach_as_much_as_one():
    """Ten epochs at 10 Hz, in each the same residuals."""
    one, many = RateErrors(), RateErrors()
    for k in range(20):
        one.learn(START + k * 0.9, quality(0.8, 8.0))
    for k in range(20 * 9):
        many.learn(START + k * 0.1, quality(0.8, 8.0))
    assert many.factor == pytest.approx(one.factor, rel=0.06)
    assert PRIOR_DOF < MEMORY_DOF


def test_a_copy_learns_on_its_own():
    """An engine for another base knows the rover's Dopplers."""
    rates = learned(0.01, 100)
    other = rates.copy()
    assert other.factor == rates.factor
    before = rates.factor
    other.learn(START + 100.0, quality(80.0, 8.0))
    assert rates.factor == before < other.factor


def test_the_velocity_behind_a_moving_base_counts_the_dopplers_of_the_base_once():
    """Drawn: a filter that adds the difference of both Dopplers to what it knew, and the base's own velocity on top."""
    rng = np.random.default_rng(2)
    roots = rng.normal(size=(3, 3, 3))
    prior, rover, base = (root @ root.T for root in roots)
    gain = prior @ np.linalg.inv(prior + rover + base)
    P = prior - gain @ prior
    known, of_rover, of_base = (rng.multivariate_normal(np.zeros(3), part, 200_000) for part in (prior, rover, base))
    relative = known + (of_rover - of_base - known) @ gain.T
    told: Any = [SimpleNamespace(velocity_cov_m2ps2=part) for part in (rover, base)]
    assert covariance_of_sum(P, told[0], told[1], (1.0, 1.0)) == pytest.approx(np.cov((relative + of_base).T), abs=0.05)
    scaled = covariance_of_sum(P, told[0], told[1], (0.1, 0.1))
    assert scaled == pytest.approx(0.1 * covariance_of_sum(P, told[0], told[1], (1.0, 1.0)), rel=1e-9)


def test_a_filter_takes_no_more_than_all_of_its_dopplers():
    """Its own covariance may be larger than theirs, in some directions or in all: that of the sum is one all the same, and where it is as
    large as theirs, what is left is the rover's own velocity.
    """
    rng = np.random.default_rng(7)
    for _ in range(200):
        roots = rng.normal(size=(3, 3, 3))
        P, rover, base = (root @ root.T for root in roots)
        told: Any = [SimpleNamespace(velocity_cov_m2ps2=part) for part in (rover, base)]
        for factors in ((1.0, 1.0), (0.05, 1.0), (1.0, 0.05)):
            assert np.linalg.eigvalsh(covariance_of_sum(P, told[0], told[1], factors))[0] > 0.0
        assert covariance_of_sum(rover + base, told[0], told[1], (1.0, 1.0)) == pytest.approx(rover, abs=1e-9)


def test_without_dopplers_of_the_rover_both_velocities_have_nothing_in_common():
    """Their covariances add."""
    P, base = np.diag([1.0, 2.0, 3.0]), np.diag([0.1, 0.2, 0.3])
    told: Any = [SimpleNamespace(velocity_cov_m2ps2=part) for part in (np.full((3, 3), nan), base)]
    assert covariance_of_sum(P, told[0], told[1], (1.0, 0.5)) == pytest.approx(P + 0.5 * base)
