"""Slip tests on made-up phases."""

import numpy as np
import pytest

from rtkmesh.rtk.bookkeeping import apply_slips, take_half_cycles
from rtkmesh.rtk.residuals import DIFFERENCE, PHASE, WAVELENGTH
from rtkmesh.rtk.slips import CERTAIN, KNOWN_SLIP, LOST, NO_SLIP, Verdicts, lost_lock
from rtkmesh.rtk.state import ARC_EPOCHS, ARC_S, HALF_CYC, HISTORY, INTEGER, REJECTS, SLIPS, STREAK
from rtkmesh.rtk.time_differences import UNTESTED, Voices, no_motion, time_difference_test

WAVELENGTH_M = 0.19


def sky(rng, n):
    direction = rng.normal(size=(n, 3))
    direction[:, 2] = np.abs(direction[:, 2]) + 0.3
    return direction / np.linalg.norm(direction, axis=1)[:, None]


def spread(n):
    """Return one satellite near the zenith and the others around."""
    azimuth, elevation = np.arange(n) * 2.0 * np.pi / (n - 1) + 0.3, np.where(np.arange(n) == 0, 1.4, 0.5 + 0.1 * np.arange(n))
    return np.stack((np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth), np.sin(elevation)), axis=1)


def moved(seed=0, n=9, slips=(), moving=True, silent=(), expected=None):
    """Test the changes of phase of a receiver that moved, with slips of whole cycles on some satellites; the silent ones do not vote."""
    rng = np.random.default_rng(seed)
    direction = sky(rng, n) if n > 7 else spread(n)
    motion = np.array([1.3, -0.4, 0.2]) if moving else np.zeros(3)
    change = -direction @ motion + 321.0 + rng.normal(size=n) * 0.003
    for k, cycles in slips:
        change[k] += cycles * WAVELENGTH_M
    found = no_motion(n)
    votes = ~np.isin(np.arange(n), silent)
    told = np.full(4, np.nan) if expected is None else np.array((*motion, expected))
    voices = Voices(np.arange(n, dtype=np.int16), direction, votes, moving, told, np.full(n, WAVELENGTH_M))
    redundancy = time_difference_test(change, np.full(n, 0.35 * WAVELENGTH_M), voices, found)
    return redundancy, found.residual_m, found.step_m[:3], motion


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


def slipped(residual_m):
    return set(np.flatnonzero(np.abs(residual_m) > 0.35 * WAVELENGTH_M).tolist())


@pytest.mark.parametrize("seed", range(5))
def test_what_does_not_vote_is_measured(seed):
    """Six of eleven satellites slip by different numbers of cycles: known ones do not disturb the fit of the others."""
    slips = ((0, 12), (2, -1), (3, 7), (5, 1), (8, -25), (9, 2))
    _, residual, found, motion = moved(seed, 11, slips, silent=[k for k, _ in slips])
    assert slipped(residual) == {k for k, _ in slips}
    assert np.abs(found - motion).max() < 0.05


@pytest.mark.parametrize("k", range(7))
@pytest.mark.parametrize("cycles", [-2, 1, 3])
def test_among_seven_satellites_one_slip_is_found_wherever_it_is(k, cycles):
    """The L1 norm alone gives way to a satellite that stands alone in its part of the sky."""
    _, residual, _, _ = moved(k, 7, ((k, cycles),))
    assert slipped(residual) == {k}


@pytest.mark.parametrize("seed", range(10))
def test_dopplers_decide_among_five(seed):
    """Five satellites cannot say which of them slipped; a motion that is known to a decimetre can."""
    k = seed % 5
    redundancy, residual, _, _ = moved(seed, 5, ((k, 3),), expected=0.08)
    assert slipped(residual) == {k}
    assert redundancy == 0


def ambiguity(integer=7.0, half_cyc=0.0):
    """Return state, covariance and history of one ambiguity, in place 1 of the state."""
    history = np.zeros((1, HISTORY))
    history[0, [ARC_EPOCHS, ARC_S, INTEGER, STREAK, HALF_CYC]] = 30.0, 5.0, integer, 2.0, half_cyc
    return np.array((0.5, 7.2)), np.diag((1.0, 0.01)), history


def put(verdict, jump_cyc, **what):
    x, P, history = ambiguity(**what)
    apply_slips(x, P, history, np.zeros(1, np.int64), Verdicts(np.array((verdict,)), np.array((jump_cyc,))), 1, 40.0)
    return x, P, history[0]


def test_a_certain_slip_moves_the_ambiguity_and_its_integer_alone():
    x, P, row = put(CERTAIN, -3.0)
    assert x.tolist() == [0.5, 4.2]
    assert P.tolist() == [[1.0, 0.0], [0.0, 0.01]]
    assert row[[INTEGER, STREAK, ARC_EPOCHS, ARC_S, SLIPS, HALF_CYC]].tolist() == [4.0, -1.0, 30.0, 5.0, 1.0, 0.0]


def test_a_measured_slip_makes_the_ambiguity_less_certain():
    x, P, row = put(KNOWN_SLIP, 1.3)
    assert x[1] == pytest.approx(8.5)
    assert P[1, 1] == pytest.approx(0.05)
    assert np.isnan(row[INTEGER])
    assert row[[ARC_EPOCHS, ARC_S, SLIPS]].tolist() == [0.0, 40.0, 1.0]


def test_a_lost_phase_begins_anew_and_no_slip_is_nothing():
    assert put(LOST, 0.0)[2][ARC_EPOCHS] == -1.0
    x, _, row = put(NO_SLIP, 0.0)
    assert (x[1], row[INTEGER], row[SLIPS]) == (7.2, 7.0, 0.0)


def test_what_did_not_fit_twice_begins_anew_whatever_the_slip():
    x, P, history = ambiguity()
    history[0, REJECTS] = 2.0
    apply_slips(x, P, history, np.zeros(1, np.int64), Verdicts(np.array((CERTAIN,)), np.array((1.0,))), 1, 40.0)
    assert history[0, ARC_EPOCHS] == -1.0


@pytest.mark.parametrize("jump_cyc", [0.5, -0.5, 1.5, -2.5])
@pytest.mark.parametrize("half_cyc", [0.0, 0.5])
def test_half_cycles_leave_held_integers_whole(jump_cyc, half_cyc):
    """State and phase move together: the phase that the filter sees, minus its ambiguity, is what it was."""
    x, _, row = put(CERTAIN, jump_cyc, half_cyc=half_cyc)
    table = np.zeros((2, DIFFERENCE))
    table[:, WAVELENGTH] = WAVELENGTH_M
    table[:, PHASE] = np.array((0.0, jump_cyc)) * WAVELENGTH_M  # before and after
    before = np.array([ambiguity(half_cyc=half_cyc)[2][0], row])
    take_half_cycles(table, before, np.arange(2))
    change_cyc = (table[1, PHASE] - table[0, PHASE]) / WAVELENGTH_M
    assert change_cyc == pytest.approx(x[1] - 7.2)
    assert row[INTEGER] - 7.0 == pytest.approx(x[1] - 7.2)
    assert row[INTEGER] == round(row[INTEGER])


def test_half_cycles_without_an_integer_are_floats():
    """Nobody knows whether the phase is right before or after."""
    x, P, row = put(CERTAIN, 0.5, integer=np.nan)
    assert x[1] == pytest.approx(7.7)
    assert P[1, 1] > 0.01
    assert row[HALF_CYC] == 0.0
