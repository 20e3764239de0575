"""What scales published covariances: closed forms, and the shadow of a filter's ambiguity on drawn codes."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from rtkmesh.gnss.frames import enu_from_ecef_at
from rtkmesh.rtk import code_errors, published
from rtkmesh.rtk.noise import PHASE, new_code_scale, phase_factor
from rtkmesh.rtk.separation import Epochwise
from rtkmesh.rtk.state import ARC_EPOCHS, HISTORY, TAKEN_M, TAKEN_M2


def test_the_factor_of_fixes_is_that_of_their_residuals_and_touches_no_other():
    """Drawn for a factor of 0.1 it is found; the factor that validation uses knows nothing of it."""
    scale, rng = new_code_scale(), np.random.default_rng(3)
    assert published.fix_factor(scale) == pytest.approx(published.PRIOR)
    for _ in range(200):
        published.learn_fix(scale, 0.1 * rng.chisquare(10), 10.0)
    assert published.fix_factor(scale) == pytest.approx(0.1, rel=0.2)
    assert scale[PHASE, published.FIX_DOF] == pytest.approx(published.MEMORY_DOF)
    assert phase_factor(scale) == 1.0


def test_the_factor_of_fixes_has_bounds():
    """Residuals of none and of metres."""
    scale = new_code_scale()
    for squares, bound in ((0.0, published.LEAST), (1e9, published.MOST)):
        for _ in range(100):
            published.learn_fix(scale, squares, 100.0)
        assert published.fix_factor(scale) == bound


@pytest.mark.parametrize(
    ("level", "satellites", "limit_m"),
    [(1.0, 5, np.inf), (np.inf, 5, np.inf), (2.0, 5, published.VAGUE_M), (9.0, 6, published.VAGUE_M), (9.0, 7, np.inf)],
)
def test_a_vague_fix_of_few_satellites_is_none_where_codes_tell_of_reflections(level, satellites, limit_m):
    """By its sigma in 3D as published; not where codes are those of the open, or nothing is known of them."""
    for sigma_m in (0.05, 0.99 * published.VAGUE_M, 1.01 * published.VAGUE_M, 1.0):
        cov_m2 = np.diag([0.2, 0.3, 0.5]) * sigma_m**2
        assert published.is_vague(cov_m2, level, satellites) == (sigma_m > limit_m)


@pytest.mark.parametrize(("length_m", "share"), [(9e3, 1.0), (15e3, 0.775), (20e3, 0.55), (50e3, 0.55)])
def test_of_a_far_fix_a_share_counts_and_without_calibrations_its_height_is_less_sure(length_m: float, share: float):
    """By 0.65 mm per km, in the direction that is up at the rover."""
    base_ecef_m, rng = np.array([3.9e6, 3.0e5, 5.0e6]), np.random.default_rng(6)
    baseline_m, root = length_m * np.array([-0.6, 0.64, 0.48]), 0.01 * rng.normal(size=(3, 3))
    P = root @ root.T
    turn = enu_from_ecef_at(base_ecef_m + baseline_m)
    known, unknown = (published.far_covariance(P, base_ecef_m, baseline_m, calibrated) for calibrated in (True, False))
    assert known == pytest.approx(share * P)
    assert turn @ (unknown - known) @ turn.T == pytest.approx(np.diag([0.0, 0.0, (0.65e-6 * length_m) ** 2]), abs=1e-12)


def test_what_an_ambiguity_takes_is_the_weighted_mean():
    """Of constant variance without growth: the plain mean, and its variance."""
    row, codes = np.full(HISTORY, np.nan), np.random.default_rng(4).normal(0.0, 0.5, 50)
    for k, code in enumerate(codes):
        row[ARC_EPOCHS] = k + 1.0
        code_errors.take(row, code, 0.25, 0.0)
    assert row[TAKEN_M] == pytest.approx(codes.mean())
    assert row[TAKEN_M2] == pytest.approx(0.25 / 50)


def test_an_ambiguity_that_begins_anew_takes_the_whole_code():
    row = np.full(HISTORY, np.nan)
    row[ARC_EPOCHS], row[TAKEN_M], row[TAKEN_M2] = 1.0, 3.0, 0.01
    code_errors.take(row, -1.0, 0.25, 0.1)
    assert (row[TAKEN_M], row[TAKEN_M2]) == (-1.0, 0.25)


def test_the_factor_of_floats_is_one_where_means_are_what_the_filter_believes():
    """Drawn with the believed variance the mean of error squared over variance is 1, however few the degrees of freedom but for the
    start; codes that last (means four times as large as believed) give 16.
    """
    rng = np.random.default_rng(5)
    assert np.mean([1.0 / code_errors.factor_of(rng.chisquare(40), 40.0) for _ in range(4000)]) == pytest.approx(1.0, abs=0.1)
    assert code_errors.factor_of(16.0 * 40, 40.0) == pytest.approx(16.0, rel=0.1)
    assert code_errors.factor_of(0.0, 1000.0) == code_errors.LEAST
    assert code_errors.factor_of(1e9, 10.0) == code_errors.MOST


def epochwise(cov: np.ndarray) -> Epochwise:
    """Return the solution of an epoch with this covariance."""
    reduced = np.zeros((4, 4))
    reduced[:3, :3] = np.linalg.inv(cov)
    return Epochwise(np.zeros((1, 5, 5)), reduced, np.zeros(3), cov, True, 1.0, 5)


@given(seed=st.integers(0, 2**32 - 1), gain=st.floats(0.01, 2.0))
def test_the_covariance_of_a_fix_is_never_larger_than_its_epochs_and_never_none(seed: int, gain: float):
    """A filter has a prior: it claims up to ``gain`` of the epoch's variance."""
    directions, rng = np.random.default_rng(seed), np.random.default_rng(seed + 1)
    A = directions.normal(size=(3, 3)) + 2.0 * np.eye(3)
    cov = 1e-6 * A @ A.T
    assume(np.linalg.cond(cov) < 1e6)  # beyond, the test's own inverse has no digits left
    U = np.linalg.cholesky(cov)
    own = U @ np.diag(gain * rng.uniform(0.01, 1.0, 3)) @ U.T
    fix = published.fix_of_both(own, epochwise(cov))
    assert np.linalg.eigvalsh(fix).min() > 0.0
    assert np.trace(fix) <= np.trace(cov) * (1.0 + 1e-9)
    assert fix == pytest.approx(fix.T, rel=1e-9, abs=1e-15)


def test_the_filters_share_of_a_fix():
    """A quarter of what it claims; claims beyond the epoch's have no part."""
    cov = np.diag([1.0, 2.0, 4.0]) * 1e-6
    assert published.fix_of_both(0.5 * cov, epochwise(cov)) == pytest.approx(0.875 * cov)
    assert published.fix_of_both(1.2 * cov, epochwise(cov)) == pytest.approx(cov)
