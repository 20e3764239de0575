"""Which fixes are shown: those that stay where the last fix and the motion since put the rover, of satellites that could object."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtkmesh.gnss.signals import KEYS_PER_SATELLITE
from rtkmesh.rtk.agreement import FAINT_ODDS, MIRRORED_CODES, PROVEN_LEAST_S
from rtkmesh.rtk.ambiguity import Candidates, Search, held_among, pairs_of
from rtkmesh.rtk.asked_odds import STREET_CODES
from rtkmesh.rtk.joining import extend, join
from rtkmesh.rtk.memory import DOUBTS, FIX_SIGMA, HELD_SINCE_S, PROVEN_S, SHOWN, new_memory, resolve_setup
from rtkmesh.rtk.options import AmbiguityOptions
from rtkmesh.rtk.placing import by_itself
from rtkmesh.rtk.predicted import FULL_STEP_S, PREDICTION_FLOOR_M, WEAK_M, carry, departure, learn_fix, share_of_step, spread
from rtkmesh.rtk.redundancy import LEAST_SATELLITES, count_satellites
from rtkmesh.rtk.state import ARC_EPOCHS, DYNAMIC, HISTORY, INTEGER, Filter
from rtkmesh.rtk.validation import (
    DEPARTURE_LIMIT,
    EXTEND_FIT,
    FEW_AMBIGUITIES,
    FIX_OK,
    FIX_SIGMA_M,
    JOIN_FIT_STREET,
    NOT_VALID,
    STREET_SIGMA_M,
    TOO_UNCERTAIN,
    extends,
    fix,
)

WAVELENGTH_M = 0.19
PHASE_SIGMA_M = 0.015
TRUE_M = np.array([120.0, -45.0, 8.0])
INTEGERS = np.array([3.0, -7.0, 12.0, 0.0, 5.0])
# Azimuth and elevation (degrees) of five satellites: one more than a fix needs.
SKY = ((10.0, 70.0), (80.0, 35.0), (160.0, 40.0), (230.0, 30.0), (310.0, 45.0))


# Four more, of another system.
OTHER_SKY = ((45.0, 50.0), (120.0, 25.0), (200.0, 65.0), (275.0, 40.0))
OTHER_INTEGERS = np.array([-2.0, 8.0, 1.0, -11.0])


def directions(sky=SKY):
    azimuth, elevation = np.radians(np.array(sky)).T
    return np.column_stack([np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)])


def floating(held, phase_sigma_m=PHASE_SIGMA_M, sky=SKY, integers=INTEGERS, satellites=None):
    """A filter after an epoch: a position known to a metre, ambiguities by the phases at that position; these integers are held."""
    n, spread = len(integers), np.zeros((DYNAMIC + len(integers), 3))
    spread[:3], spread[DYNAMIC:] = np.eye(3), directions(sky) / WAVELENGTH_M
    P = spread @ spread.T
    P[3:DYNAMIC, 3:DYNAMIC] = np.eye(6)
    P[DYNAMIC:, DYNAMIC:] += (phase_sigma_m / WAVELENGTH_M) ** 2 * np.eye(n)
    error_m = np.array([0.4, -0.3, 0.5])
    x = np.concatenate([TRUE_M + error_m, np.zeros(6), integers + directions(sky) @ error_m / WAVELENGTH_M])
    history = np.zeros((n, HISTORY))
    history[:, INTEGER] = held
    numbers = np.arange(n) + 1 if satellites is None else satellites
    return Filter(x, P, numbers * KEYS_PER_SATELLITE + np.arange(n), history)


FEW = AmbiguityOptions(minimum_ambiguities=4)  # so that one satellite more than is needed can be a fix here


def fixed(
    held, prediction, level=1.0, last_sigma_m=0.0, phase_sigma_m=PHASE_SIGMA_M, proven_s=PROVEN_LEAST_S, odds=-np.inf, options=FEW,
    length_m=None,
):  # fmt: skip
    """What is shown of these integers with this prediction, and the doubts it leaves."""
    n, memory = len(INTEGERS), new_memory()
    memory[SHOWN], memory[HELD_SINCE_S], memory[FIX_SIGMA], memory[PROVEN_S] = 1.0, 0.0, last_sigma_m, proven_s
    candidates = Candidates(np.arange(n), np.zeros(n, np.int64), np.arange(n) + 1, np.arange(n) + 1.0)
    free = Search(np.zeros((0, 2), np.int64), np.zeros(0), np.zeros(0), np.inf, np.inf, 0.0, odds, False)
    setup = resolve_setup(options, length_m, 0.01)
    f = floating(held, phase_sigma_m)
    held = pairs_of(held_among(f, candidates))
    return fix(by_itself(f, held), free, memory, setup, prediction, 1.0, level), memory[DOUBTS]


def predicted(at_m, sigma_m=0.01):
    return np.concatenate([at_m, [sigma_m], np.zeros(3)])


def test_a_cycle_that_few_satellites_hide_is_seen_by_where_it_puts_the_rover():
    """One satellite a cycle off, with one to spare: its norm passes, and so does its sigma, but the rover has not gone there."""
    wrong = INTEGERS + np.array([0.0, 0.0, 1.0, 0.0, 0.0])
    right, doubts = fixed(INTEGERS, predicted(TRUE_M))
    assert (right.reason, doubts) == (FIX_OK, 0.0)
    assert right.x[:3] == pytest.approx(TRUE_M, abs=5e-3)
    unseen, _ = fixed(wrong, np.full(7, np.nan))
    assert unseen.reason == FIX_OK
    assert np.linalg.norm(unseen.x[:3] - TRUE_M) > 0.1
    seen, doubts = fixed(wrong, predicted(TRUE_M))
    assert (seen.reason, doubts) == (NOT_VALID, 1.0)


def test_four_integers_are_no_fix_unless_the_length_is_known():
    """However long they are held; as many as are asked of new ones."""
    usual, at_m = AmbiguityOptions(), predicted(TRUE_M)
    assert usual.minimum_ambiguities == 5
    few = fixed(INTEGERS, at_m, options=usual)[0]
    assert (few.reason, few.fixed, few.integers) == (FEW_AMBIGUITIES, False, 0)
    assert fixed(INTEGERS, at_m, options=usual, length_m=130.0)[0].reason == FIX_OK


def test_a_prediction_that_says_little_refuses_little():
    """The same fix is shown when the motion since the last one is not known better than that."""
    wrong = INTEGERS + np.array([0.0, 0.0, 1.0, 0.0, 0.0])
    assert fixed(wrong, predicted(TRUE_M, 0.5))[0].reason == FIX_OK


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 2.0))
def test_departures_are_normalised_by_both(seed, sigma_m):
    """The squared distance in sigmas of fix and prediction, by the textbook."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(DYNAMIC, DYNAMIC))
    P, x, at_m = 1e-3 * A @ A.T + 1e-5 * np.eye(DYNAMIC), rng.normal(size=DYNAMIC), rng.normal(size=3)
    gap_m, cov_m2 = x[:3] - at_m, P[:3, :3] + (PREDICTION_FLOOR_M + sigma_m) ** 2 * np.eye(3)
    assert departure(x, P, predicted(at_m, sigma_m)) == pytest.approx(gap_m @ np.linalg.solve(cov_m2, gap_m), rel=1e-9)


def drifted_m(rate_hz, by_the_second=True):
    """How far (m) fixes that drift by 0.4 m/s go before one is refused; 2 m where none is."""
    prediction, P = predicted(TRUE_M, 0.0), 1e-4 * np.eye(DYNAMIC)
    share = share_of_step(1.0 / rate_hz) if by_the_second else 1.0
    for k in range(5 * rate_hz):
        x = np.concatenate([TRUE_M + np.array([0.4 * (k + 1) / rate_hz, 0.0, 0.0]), np.zeros(6)])
        spread(prediction, 0.003, share)
        if departure(x, P, prediction) > DEPARTURE_LIMIT:
            return x[0] - TRUE_M[0]
        learn_fix(prediction, x, share)
    return 2.0


def test_fixes_that_drift_are_seen_at_every_rate():
    """Against what the fixes of the last second say; against the last one alone nothing is to be seen of it at 10 Hz."""
    assert drifted_m(1) == pytest.approx(0.4)
    assert drifted_m(10) < 0.2
    assert drifted_m(20) < 0.2
    assert drifted_m(10, by_the_second=False) == 2.0


def test_at_a_hertz_a_prediction_begins_with_the_last_fix():
    """So it does where nothing was known before, or nothing is known of the step; else it comes as near as the step is long."""
    x, before = TRUE_M + 0.1, predicted(TRUE_M, 0.02)
    for share, prediction, moved in (
        (share_of_step(1.0), before.copy(), 1.0),
        (share_of_step(np.nan), before.copy(), 1.0),
        (0.25, np.full(7, np.nan), 1.0),
        (share_of_step(0.1), before.copy(), 0.1 / FULL_STEP_S),
    ):
        learn_fix(prediction, x, share)
        assert prediction[:3] == pytest.approx(TRUE_M + 0.1 * moved, abs=1e-9)
        assert prediction[3] == pytest.approx(0.02 * (1.0 - moved), abs=1e-12)


def sigma_m(resolution):
    return np.sqrt(np.trace(resolution.P[:3, :3]))


def test_in_streets_a_fix_must_be_better_known():
    """The same fix of few satellites: good enough where codes are fair, or their noise is not known, but not where they are reflected."""
    street, unpredicted = STREET_CODES + 1.0, np.full(7, np.nan)
    fair, _ = fixed(INTEGERS, unpredicted, phase_sigma_m=0.03)
    assert STREET_SIGMA_M < sigma_m(fair) < FIX_SIGMA_M
    assert fair.reason == fixed(INTEGERS, unpredicted, np.inf, phase_sigma_m=0.03)[0].reason == FIX_OK
    assert fixed(INTEGERS, unpredicted, street, phase_sigma_m=0.03)[0].reason == TOO_UNCERTAIN


def test_the_last_fix_helps_one_that_few_satellites_carry():
    """Good fixes before, then few satellites: the last one, moved on, is known better than this one; a bad one before helps little."""
    street, at_m = STREET_CODES + 1.0, TRUE_M + np.array([0.02, 0.0, -0.02])
    alone, _ = fixed(INTEGERS, np.full(7, np.nan), phase_sigma_m=0.03)
    helped, _ = fixed(INTEGERS, predicted(at_m, 0.005), street, 0.015, 0.03)
    little, _ = fixed(INTEGERS, predicted(at_m, 0.005), street, 1.0, 0.03)
    assert helped.reason == FIX_OK
    assert sigma_m(helped) < STREET_SIGMA_M
    assert np.linalg.norm(helped.x[:3] - at_m) < np.linalg.norm(alone.x[:3] - at_m)
    assert little.x[:3] == pytest.approx(alone.x[:3], abs=1e-3)
    assert little.reason == TOO_UNCERTAIN


def test_few_integers_must_be_proven_where_codes_are_reflected():
    """New ones that a search hardly gives are hidden until searches have given them clearly; where codes are fair they are shown."""
    street, at_m, faint = MIRRORED_CODES + 0.1, predicted(TRUE_M), FAINT_ODDS - 0.1
    assert fixed(INTEGERS, at_m, street, proven_s=0.0, odds=faint)[0].reason == NOT_VALID
    for level, proven_s, odds in ((street, 0.0, FAINT_ODDS), (street, PROVEN_LEAST_S, faint), (MIRRORED_CODES, 0.0, faint)):
        assert fixed(INTEGERS, at_m, level, proven_s=proven_s, odds=odds)[0].reason == FIX_OK
    assert fixed(INTEGERS, at_m, np.inf, proven_s=0.0, odds=faint)[0].reason == FIX_OK


def test_fixes_of_many_satellites_stay_as_they_are():
    """What is known well is not moved by what was before."""
    alone, _ = fixed(INTEGERS, np.full(7, np.nan), phase_sigma_m=0.003)
    assert sigma_m(alone) < WEAK_M
    beside, _ = fixed(INTEGERS, predicted(TRUE_M + 0.01, 0.005), last_sigma_m=0.005, phase_sigma_m=0.003)
    assert np.array_equal(beside.x, alone.x)


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.5), st.floats(0.0, 0.5))
def test_the_last_fix_is_an_observation(seed, sigma_m, last_sigma_m):
    """State and covariance are those of a Kalman update with its place, by the textbook."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(DYNAMIC, DYNAMIC))
    P, x, at_m = 1e-2 * A @ A.T + 1e-5 * np.eye(DYNAMIC), rng.normal(size=DYNAMIC), rng.normal(size=3)
    H, R = np.eye(3, DYNAMIC), (last_sigma_m**2 + (PREDICTION_FLOOR_M + sigma_m) ** 2) * np.eye(3)
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    wanted_x, wanted_P = x + K @ (at_m - H @ x), P - K @ H @ P
    carry(x, P, predicted(at_m, sigma_m), last_sigma_m)
    assert x == pytest.approx(wanted_x, rel=1e-6, abs=1e-8)
    assert pytest.approx(wanted_P, rel=1e-6, abs=1e-8) == P


@pytest.mark.parametrize(("off_cyc", "fit", "joins"), [(0.0, 4.0, True), (0.3, 8.0, True), (0.3, JOIN_FIT_STREET, False)])
def test_a_reflected_phase_does_not_join_in_streets(off_cyc, fit, joins):
    """Four satellites are held; the fifth has a phase that is a part of a cycle off: too far for its sigma to be that of an integer."""
    held = INTEGERS.copy()
    held[2] = np.nan
    f = floating(held, 0.012)
    f.x[DYNAMIC + 2] += off_cyc
    f.history[:, ARC_EPOCHS] = 5.0
    n = len(INTEGERS)
    candidates = Candidates(np.arange(n), np.zeros(n, np.int64), np.arange(n) + 1, np.arange(n) + 1.0)
    pairs = np.array([[k + DYNAMIC, n - 1 + DYNAMIC] for k in (0, 1, 3)])
    join(f, f, candidates, pairs, fit, True)
    assert (f.history[2, INTEGER] == INTEGERS[2]) == joins
    assert np.isnan(f.history[2, INTEGER]) != joins


@pytest.mark.parametrize(("off_cyc", "groups", "joins"), [(0.0, True, True), (0.0, False, False), (0.4, True, False)])
def test_a_system_of_which_nothing_is_held_joins(off_cyc, groups, joins):
    """Five satellites of one clock group are held; four of another have integers against each other, if these are integers."""
    n, other = len(INTEGERS), len(OTHER_INTEGERS)
    held, group = np.concatenate([INTEGERS, np.full(other, np.nan)]), np.repeat([0, 1], [n, other])
    f = floating(held, 0.005, SKY + OTHER_SKY, np.concatenate([INTEGERS, OTHER_INTEGERS + 0.3]))
    f.x[DYNAMIC + n] += off_cyc
    f.history[:, ARC_EPOCHS] = 5.0
    candidates = Candidates(np.arange(n + other), group, np.arange(n + other) + 1, np.arange(n + other) + 1.0)
    pairs = np.array([[k + DYNAMIC, n - 1 + DYNAMIC] for k in range(n - 1)])
    join(f, f, candidates, pairs, JOIN_FIT_STREET, groups)
    found = f.history[n:, INTEGER]
    assert np.isfinite(found).all() == joins
    assert np.array_equal(found - found[-1], OTHER_INTEGERS - OTHER_INTEGERS[-1]) == joins


@pytest.mark.parametrize(("count", "length_m", "reason"), [(5, None, FIX_OK), (4, None, NOT_VALID), (4, 130.0, FIX_OK)])
def test_four_satellites_are_not_shown(count, length_m, reason):
    """On two bands they have six double differences and nothing that could object; with a known length of the baseline they have one."""
    sky, integers, satellites = SKY[:count] * 2, np.tile(INTEGERS[:count], 2), np.tile(np.arange(count) + 1, 2)
    order = np.argsort(satellites, kind="stable")
    sky, integers, satellites = tuple(sky[k] for k in order), integers[order], satellites[order]
    f, memory, n = floating(integers, 0.005, sky, integers, satellites), new_memory(), len(integers)
    memory[SHOWN], memory[HELD_SINCE_S] = 1.0, 0.0
    candidates = Candidates(np.arange(n), np.tile([0, 1], count), satellites, np.arange(n) + 1.0)
    free = Search(np.zeros((0, 2), np.int64), np.zeros(0), np.zeros(0), np.inf, np.inf, 0.0, -np.inf, False)
    prediction = predicted(TRUE_M)
    held = pairs_of(held_among(f, candidates))
    shown = fix(by_itself(f, held), free, memory, resolve_setup(AmbiguityOptions(), length_m, 0.01), prediction, 1.0, 1.0)
    assert shown.reason == reason
    assert np.linalg.norm(prediction[:3] - TRUE_M) < 0.02


@given(st.lists(st.tuples(st.integers(1, 12), st.integers(0, 2)), min_size=2, max_size=20, unique=True), st.randoms())
def test_satellites_are_counted_once(keys, random):
    """Whatever their bands, and whether they are references."""
    keys.sort()
    n = len(keys)
    f = Filter(np.zeros(DYNAMIC + n), np.zeros((0, 0)), np.array([s * KEYS_PER_SATELLITE + b for s, b in keys]), np.zeros((n, HISTORY)))
    pairs = np.array([random.sample(range(n), 2) for _ in range(random.randint(1, n))])
    assert count_satellites(f, pairs + DYNAMIC) == len({keys[k][0] for k in pairs.ravel()})
    assert LEAST_SATELLITES == 5


def searched(f, pairs, integers):
    return Search(pairs, integers, np.full(len(f.keys), np.nan), 0.0, np.inf, 1.0, 20.0, True)


@pytest.mark.parametrize("reference", [0, 4])
def test_integers_that_a_search_gives_beside_the_held_ones_are_held(reference):
    """Two of five are held, with an offset of their own; whichever the reference is, all have that offset then."""
    held = np.array([np.nan, -7.0, 12.0, np.nan, np.nan]) + 40.0
    f, others = floating(held), np.delete(np.arange(5), reference)
    pairs = np.column_stack([others, np.full(4, reference)]) + DYNAMIC
    extend(f, searched(f, pairs, INTEGERS[others] - INTEGERS[reference]))
    assert f.history[:, INTEGER] == pytest.approx(INTEGERS + 40.0, abs=0.0)


def test_a_group_of_which_nothing_is_held_is_held_by_its_rounded_reference():
    held = np.concatenate([INTEGERS, np.full(4, np.nan)])
    f = floating(held, sky=SKY + OTHER_SKY, integers=np.concatenate([INTEGERS, OTHER_INTEGERS]))
    pairs = np.array([(6, 5), (7, 5), (8, 5)]) + DYNAMIC
    extend(f, searched(f, pairs, OTHER_INTEGERS[1:] - OTHER_INTEGERS[0]))
    assert f.history[:5, INTEGER] == pytest.approx(INTEGERS, abs=0.0)
    assert f.history[5, INTEGER] == np.rint(f.x[DYNAMIC + 5])
    assert np.diff(f.history[5:, INTEGER]) == pytest.approx(np.diff(OTHER_INTEGERS), abs=0.0)


@pytest.mark.parametrize(
    ("count", "odds", "near", "far"), [(5, 9.0, True, False), (12, 9.0, True, False), (13, 9.0, True, True), (20, 6.9, False, False)]
)
def test_beyond_10_km_few_integers_of_a_search_are_not_added(count, odds, near, far):
    """As a new fix would not be believed from them there: the atmosphere can make them fit."""
    pairs = np.column_stack([np.arange(count) + 1, np.zeros(count, np.int64)]) + DYNAMIC
    for length_m, expected in ((9e3, near), (35e3, far)):
        f = floating(INTEGERS)
        f.x[:3] = 0.0, length_m, 0.0
        found = searched(f, pairs, np.zeros(count))._replace(odds=odds)
        assert extends(f, found, 7.0) == expected
        assert not extends(f, found._replace(norm=1.01 * EXTEND_FIT * count), 7.0)
