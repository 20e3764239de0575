"""Slip tests on made-up phases."""

import numpy as np
import pytest

from rtkmesh.rtk.slips import UNTESTED, lost_lock, time_difference_test

WAVELENGTH_M = 0.19


def sky(rng, n):
    direction = rng.normal(size=(n, 3))
    direction[:, 2] = np.abs(direction[:, 2]) + 0.3
    return direction / np.linalg.norm(direction, axis=1)[:, None]


def moved(seed=0, n=9, slips=(), moving=True):
    """Test the changes of phase of a receiver that moved, with slips of whole cycles on some satellites."""
    rng = np.random.default_rng(seed)
    direction = sky(rng, n)
    motion = np.array([1.3, -0.4, 0.2]) if moving else np.zeros(3)
    change = -direction @ motion + 321.0 + rng.normal(size=n) * 0.003
    for k, cycles in slips:
        change[k] += cycles * WAVELENGTH_M
    residual, found, covariance = np.empty(n), np.empty(3), np.empty((3, 3))
    threshold = np.full(n, 0.35 * WAVELENGTH_M)
    redundancy = time_difference_test(change, direction, threshold, moving, residual, found, covariance)
    return redundancy, residual, found, motion


@pytest.mark.parametrize("seed", range(5))
def test_single_cycle_slips_on_one_frequency_are_found(seed):
    """One and two slips of one cycle among nine satellites are flagged, nothing else is, and the motion is right."""
    for slips in ((), ((2, 1),), ((2, 1), (6, -1)), ((0, -37),)):
        redundancy, residual, found, motion = moved(seed, 10, slips)
        flagged = set(np.flatnonzero(np.abs(residual) > 0.35 * WAVELENGTH_M).tolist())
        assert flagged == {k for k, _ in slips}
        assert redundancy == 10 - 4 - len(slips)
        assert np.abs(found - motion).max() < 0.03
        for k, cycles in slips:
            assert residual[k] / WAVELENGTH_M == pytest.approx(cycles, abs=0.15)


def test_a_standing_receiver_needs_only_its_clock():
    redundancy, residual, _, _ = moved(1, 4, ((1, 1),), moving=False)
    assert redundancy == 2
    assert np.flatnonzero(np.abs(residual) > 0.35 * WAVELENGTH_M).tolist() == [1]


def test_too_few_satellites_are_untested():
    assert moved(1, 4)[0] == UNTESTED


@pytest.mark.parametrize(
    ("lock_s", "before_s", "elapsed_s", "lost"),
    [
        (10.0, 9.0, 1.0, False),
        (0.2, 9.0, 1.0, True),
        (0.1, 0.0, 1.0, True),
        (0.3, 0.2, 1.0, False),
        (np.nan, 9.0, 1.0, False),
        (64.5, 64.5, 1.0, False),
    ],
)
def test_lock_times(lock_s, before_s, elapsed_s, lost):
    """A lock time that fell, or that is too short for the gap even as a lower bound, means that lock was lost."""
    assert bool(lost_lock(lock_s, before_s, elapsed_s)) == lost
