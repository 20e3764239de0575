"""Protection levels, fix probabilities and the flag: closed forms, invariants, and what a solution says of itself."""

from dataclasses import replace
from math import exp, inf, isfinite, nan, radians

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.rtk.bits import same_bits

from rtkmesh.errors import OptionError
from rtkmesh.gnss.frames import enu_from_ecef_at
from rtkmesh.gnss.integrity import Integrity
from rtkmesh.gnss.signals import satellite_number
from rtkmesh.gnss.time import GpsTime
from rtkmesh.models.ephemeris_table import EphemerisTable
from rtkmesh.rtk.engine import Rtk
from rtkmesh.rtk.integrity import (
    HIDDEN_FAULT,
    HIDDEN_M,
    INFLATION,
    SATELLITE_FAULT,
    SPARE_LEAST,
    WRONG_FAR,
    WRONG_LEAST,
    WRONG_NEAR,
    WRONG_UNAGREED,
    Place,
    chi2_limit,
    protect,
    widening,
    wrong_probability,
)
from rtkmesh.rtk.local import in_enu
from rtkmesh.rtk.options import AmbiguityMode, AmbiguityOptions, IntegrityOptions, Mode, RtkOptions
from rtkmesh.rtk.separation import CLOCK, COLUMNS, RANGE, Ranges, horizontal_sigma, solve_epoch
from rtkmesh.rtk.solution import IntegrityReason, Reason, Solution, Status
from rtkmesh.rtk.verdict import verdict
from rtkmesh.simulation.classes import F9P, SURVEY, moving
from rtkmesh.simulation.receiver import Receiver
from rtkmesh.simulation.sky import SATELLITES, broadcast
from rtkmesh.simulation.trajectories import AntennaPath, Site, driving

SATELLITES_SEEN = 8


def ranges_of(rng: np.random.Generator, value_m: np.ndarray, sigma_m: float) -> Ranges:
    n = len(value_m)
    enu = rng.normal(size=(n, 3))
    enu[:, 2] = abs(enu[:, 2]) + 0.2
    rows = np.ones((n, COLUMNS))
    rows[:, :3], rows[:, RANGE], rows[:, CLOCK] = -enu / np.linalg.norm(enu, axis=1)[:, None], value_m, 1.0
    return Ranges(rows, np.full(n, sigma_m**-2), np.zeros(n, np.int64), np.arange(n, dtype=np.int16), 1)


def levels_of(ranges: Ranges, prior: float = 1.0, risk: float = 1e-4) -> np.ndarray:
    whole, levels = solve_epoch(ranges), np.zeros(2)
    protect(levels, whole.place, Place(whole.place, whole.cov), ranges, whole, prior, risk)
    return levels


@pytest.mark.parametrize(("prior", "budget"), [(1.0, 1e-5), (0.5, 1e-3), (1e-3, 1e-7)])
def test_a_widening_leaves_its_budget_outside(prior: float, budget: float):
    """Two equal axes are Rayleigh: prior exp(-k^2 / 2) is the budget; a hypothesis within the budget asks for nothing."""
    assert prior * exp(-0.5 * widening(prior, budget) ** 2) == pytest.approx(budget)
    assert widening(budget, prior) < 0.0


def test_levels_of_a_sound_epoch_in_closed_form():
    """With ranges that fit exactly every separation is zero: the level is the largest k sigma of the hypotheses."""
    ranges = ranges_of(np.random.default_rng(5), np.zeros(SATELLITES_SEEN), 0.02)
    risk = 1e-4
    expected = INFLATION * widening(1.0, 0.25 * risk) * np.array([horizontal_sigma(solve_epoch(ranges).cov), 0.0])
    fault = INFLATION * widening(SATELLITE_FAULT, 0.25 * risk / SATELLITES_SEEN)
    for s in range(SATELLITES_SEEN):
        weight = ranges.weight.copy()
        weight[s] = 0.0
        expected[0] = max(expected[0], fault * horizontal_sigma(solve_epoch(ranges._replace(weight=weight)).cov))
    assert levels_of(ranges, 1.0, risk)[0] == pytest.approx(expected[0])


@given(st.integers(0, 500), st.floats(1e-3, 1e3))
def test_levels_scale_with_errors_and_sigmas(seed: int, scale: float):
    """Millimetres or metres: the unit is free."""
    values = np.random.default_rng(seed + 1).normal(size=SATELLITES_SEEN)
    one = levels_of(ranges_of(np.random.default_rng(seed), values, 1.0))
    other = levels_of(ranges_of(np.random.default_rng(seed), scale * values, scale))
    np.testing.assert_allclose(other, scale * one, rtol=1e-6)


@given(st.integers(0, 500), st.floats(1e-9, 1e-3), st.floats(1.0, 100.0))
def test_less_risk_is_never_a_smaller_level(seed: int, risk: float, factor: float):
    """Levels fall with the risk that is taken, and with the probability of the hypothesis."""
    rng = np.random.default_rng(seed)
    ranges = ranges_of(rng, rng.normal(size=SATELLITES_SEEN), 1.0)
    assert (levels_of(ranges, 1.0, risk) >= levels_of(ranges, 1.0, min(risk * factor, 0.1))).all()
    assert (levels_of(ranges, 1.0, risk) >= levels_of(ranges, 1.0 / factor, risk)).all()


def test_four_satellites_have_no_level():
    """Without any one of them there is no solution: nothing bounds the error."""
    assert (levels_of(ranges_of(np.random.default_rng(2), np.zeros(4), 1.0)) == inf).all()


def test_levels_hold_a_bias_of_any_size_on_any_satellite():
    """One satellite is off by a millimetre to a kilometre: of 300 epochs at a risk of 10 % fewer are beyond, whatever the size."""
    rng, beyond = np.random.default_rng(11), 0
    for _ in range(300):
        values = 0.01 * INFLATION * rng.normal(size=SATELLITES_SEEN)
        values[rng.integers(SATELLITES_SEEN)] += 10.0 ** rng.uniform(-3.0, 3.0)
        ranges = ranges_of(rng, values, 0.01)
        levels, place = levels_of(ranges, 1.0, 0.1 * SATELLITE_FAULT), solve_epoch(ranges).place
        beyond += bool(np.hypot(place[0], place[1]) > levels[0] or abs(place[2]) > levels[1])
    assert beyond <= 30


def test_the_probability_of_wrong_integers():
    """Falls with the log odds, sooner with codes of survey antennas, later with the atmosphere between; never below what data support nor
    above what they show.
    """
    patch, survey = 1.0, 0.1
    assert wrong_probability(12.0, 0.0, SPARE_LEAST, 0.0, patch) == pytest.approx(exp(-8.0))
    assert wrong_probability(12.0, 0.0, SPARE_LEAST, 0.0, survey) == pytest.approx(exp(-12.0))
    assert wrong_probability(12.0, 0.0, SPARE_LEAST, 5e3, patch) == pytest.approx(exp(-12.0 / 2.25))
    for level in (patch, survey, inf):
        assert wrong_probability(12.0, 0.0, SPARE_LEAST, 10e3, level) == pytest.approx(exp(-4.0))
        assert (
            wrong_probability(12.0, 0.0, SPARE_LEAST, 10.1e3, level)
            == wrong_probability(12.0, 0.0, SPARE_LEAST, 50e3, level)
            == pytest.approx(exp(-6.0))
        )
        assert wrong_probability(12.0, 6.0, SPARE_LEAST, 20e3, level) == WRONG_UNAGREED
        assert wrong_probability(12.0, 6.0, SPARE_LEAST, 0.0, level) == wrong_probability(-inf, 0.0, SPARE_LEAST, 0.0, level) == WRONG_NEAR
        assert wrong_probability(-inf, 0.0, SPARE_LEAST, 5e3, level) == pytest.approx(0.5 * (WRONG_NEAR + WRONG_FAR))
        assert (
            wrong_probability(-inf, 0.0, SPARE_LEAST, 10e3, level)
            == wrong_probability(-inf, 0.0, SPARE_LEAST, 50e3, level)
            == pytest.approx(WRONG_FAR)
        )
        assert wrong_probability(500.0, 0.0, SPARE_LEAST, 0.0, level) == WRONG_LEAST
        assert wrong_probability(500.0, 0.0, SPARE_LEAST - 1, 0.0, level) == (WRONG_NEAR if isfinite(level) else WRONG_LEAST)
        assert wrong_probability(500.0, 0.0, SPARE_LEAST - 1, 20e3, level) == WRONG_LEAST


@pytest.mark.parametrize(("dof", "quantile"), [(3.0, 21.108), (10.0, 35.564), (30.0, 66.619)])
def test_limits_of_chi_squares(dof: float, quantile: float):
    """Quantiles at 0.9999 (tabulated) of variances that are inflated; the approximation errs upwards, by 4 % at 3 degrees."""
    assert 1.0 <= chi2_limit(dof) / (INFLATION**2 * quantile) < 1.04


FIXED_M = np.array([2.0, 1.0, 0.5, *[0.0] * 6])
NO_COV = np.eye(9) * 1e-6
MOVING_BASE = RtkOptions(mode=Mode.MOVING_BASE, baseline_length_m=2.5)


@pytest.mark.parametrize(
    ("tests", "levels_m", "options", "expected"),
    [
        ((0.5, nan, 0.9), (0.1, 0.2), RtkOptions(), (Integrity.OK, IntegrityReason.OK)),
        ((1.1, 0.0, 0.0), (0.1, 0.2), RtkOptions(), (Integrity.FAILED, IntegrityReason.RESIDUALS)),
        ((nan, 2.0, 3.0), (0.1, 0.2), RtkOptions(), (Integrity.FAILED, IntegrityReason.FLOAT)),
        ((0.0, 0.0, 1.5), (inf, inf), RtkOptions(), (Integrity.FAILED, IntegrityReason.CODES)),
        ((0.0, 0.0, 0.0), (0.1, 0.2), MOVING_BASE, (Integrity.FAILED, IntegrityReason.LENGTH)),
        ((0.0, 0.0, 0.0), (0.1, 0.2), replace(MOVING_BASE, baseline_length_m=2.2913), (Integrity.OK, IntegrityReason.OK)),
        ((0.0, 0.0, 0.0), (inf, 0.2), RtkOptions(), (Integrity.UNAVAILABLE, IntegrityReason.NO_REDUNDANCY)),
        ((0.0, 0.0, 0.0), (0.1, 9.0), RtkOptions(), (Integrity.UNAVAILABLE, IntegrityReason.ALERT_LIMIT)),
        ((nan, nan, nan), (nan, nan), RtkOptions(), (Integrity.UNAVAILABLE, IntegrityReason.NOT_WATCHED)),
    ],
)
def test_the_flag(
    tests: tuple[float, ...], levels_m: tuple[float, float], options: RtkOptions, expected: tuple[Integrity, IntegrityReason]
):
    """A failed test goes before levels that are too large; what was not computed is unavailable."""
    assert verdict(Status.FIX, tests, levels_m, FIXED_M, NO_COV, options) == expected


@pytest.mark.parametrize("wrong", [{"risk": 0.0}, {"risk": 0.5}, {"alert_horizontal_m": 0.0}, {"alert_vertical_m": nan}])
def test_senseless_options_are_refused(wrong: dict[str, float]):
    """Before anything is solved."""
    with pytest.raises(OptionError):
        IntegrityOptions(**wrong)


# --- what a solution says of itself ---

START = GpsTime(2445, 100000.0)
SITE = Site(radians(47.0), radians(8.0), 400.0)


@pytest.fixture(scope="module")
def scene() -> tuple[list, np.ndarray, np.ndarray]:
    """A drive of eight epochs: pairs of epochs, true positions, the base."""
    rover = Receiver("rover", AntennaPath(SITE, driving, (0.0, 0.0, -1.5)), 5, replace(F9P, signals=moving(F9P.signals, 8.0)))
    base = Receiver("base", AntennaPath(SITE, None, (-320.0, 210.0, 4.0)), 5, replace(SURVEY, steered=True))
    seen = [(rover.observe(START + float(k)), base.observe(START + float(k))) for k in range(8)]
    return [(r.epoch, b.epoch) for r, b in seen], np.array([r.position_ecef_m for r, _ in seen]), seen[0][1].position_ecef_m


def solved(scene: tuple[list, np.ndarray, np.ndarray], options: RtkOptions) -> list[Solution]:
    engine, table = Rtk(options), EphemerisTable()
    for satellite in SATELLITES.tolist():
        table.add(broadcast(satellite, START))
    return [engine.step(r, b, table, base_position_ecef_m=scene[2]) for r, b in scene[0]]


@pytest.mark.slow
def test_a_fix_under_open_sky_is_ok_and_inside_its_levels(scene: tuple[list, np.ndarray, np.ndarray]):
    """Centimetres of level, sure integers, and an acceleration with a covariance."""
    for solution, truth in zip(solved(scene, RtkOptions()), scene[1], strict=True):
        east, north, up = enu_from_ecef_at(truth) @ (solution.position_ecef_m - truth)
        assert (solution.status, solution.integrity, solution.integrity_reason) == (Status.FIX, Integrity.OK, IntegrityReason.OK)
        assert solution.fix_probability >= 1.0 - 2.0 * WRONG_LEAST
        assert np.hypot(east, north) <= solution.protection_horizontal_m < 0.1
        assert abs(up) <= solution.protection_vertical_m < 0.2
        assert (np.linalg.eigvalsh(solution.acceleration_cov_ecef_m2ps4) > 0.0).all()


@pytest.mark.slow
@pytest.mark.parametrize(("systems", "hidden"), [("GE", False), ("C", True)])
def test_a_weak_geometry_makes_no_sure_fix(scene: tuple[list, np.ndarray, np.ndarray], systems: str, hidden: bool):
    """However sure the search is: where one of seven satellites could hide 0.15 m a slip may have done so; of fourteen none can."""
    last = solved(scene, RtkOptions(systems=systems))[-1]
    assert last.status is Status.FIX
    assert (max(last.protection_horizontal_m, last.protection_vertical_m) > HIDDEN_M) == hidden
    assert (1.0 - last.fix_probability >= 7.0 * HIDDEN_FAULT) == hidden


@pytest.mark.slow
def test_a_float_has_no_fix_probability_and_levels_of_its_codes(scene: tuple[list, np.ndarray, np.ndarray]):
    """It may be used where metres are enough."""
    last = solved(scene, RtkOptions(ambiguity=AmbiguityOptions(mode=AmbiguityMode.OFF)))[-1]
    assert (last.status, last.fix_probability, last.integrity_reason) == (Status.FLOAT, 0.0, IntegrityReason.ALERT_LIMIT)
    assert 0.5 < last.protection_horizontal_m < 50.0


@pytest.mark.slow
def test_a_failure_rate_hides_fixes_and_changes_nothing_else(scene: tuple[list, np.ndarray, np.ndarray]):
    """What is less sure than configured is the float solution with its levels; what is surer is the same to the last bit."""
    weak = RtkOptions(systems="C")
    plain = solved(scene, weak)
    doubts = [1.0 - one.fix_probability for one in plain if one.status is Status.FIX]
    rate = 0.5 * (min(doubts) + max(doubts))
    strict = solved(scene, replace(weak, ambiguity=AmbiguityOptions(failure_rate=rate)))
    hidden = [one.status is Status.FIX and 1.0 - one.fix_probability > rate for one in plain]
    assert any(hidden)
    for one, other, is_hidden in zip(plain, strict, hidden, strict=True):
        if is_hidden:
            assert (other.status, other.reason, other.fix_probability) == (Status.FLOAT, Reason.FAILURE_RATE, 0.0)
            assert (other.ambiguities_fixed, other.grade, other.ratio) == (0, 0, one.ratio)
            assert np.trace(other.position_cov_ecef_m2) > np.trace(one.position_cov_ecef_m2)
        else:
            assert np.array_equal(one.position_ecef_m, other.position_ecef_m)
            assert one.reason is other.reason


def test_a_failure_rate_needs_a_probability():
    """Without integrity nothing says how probably a fix is wrong; no rate at all is no rate."""
    with pytest.raises(OptionError, match="needs integrity"):
        RtkOptions(ambiguity=AmbiguityOptions(failure_rate=0.1), integrity=IntegrityOptions(enabled=False))
    for rate in (0.0, 1.1, nan):
        with pytest.raises(OptionError, match="failure rate"):
            AmbiguityOptions(failure_rate=rate)


@pytest.mark.slow
def test_watching_changes_nothing_else(scene: tuple[list, np.ndarray, np.ndarray]):
    """Switched off, integrity is unavailable and all other fields are the same to the last bit."""
    watched, alone = solved(scene, RtkOptions()), solved(scene, RtkOptions(integrity=IntegrityOptions(enabled=False)))
    assert {s.integrity_reason for s in alone} == {IntegrityReason.NOT_WATCHED}
    own = {"fix_probability", "integrity", "integrity_reason", "protection_horizontal_m", "protection_vertical_m", "satellites"}
    for one, other in zip(watched, alone, strict=True):
        assert same_bits(replace(one, **{name: getattr(other, name) for name in own}), other)


def test_a_solution_turned_into_its_local_frame_keeps_lengths_and_traces():
    """Velocity and acceleration, with covariances; without a position nothing is known."""
    rng = np.random.default_rng(4)
    root = rng.normal(size=(2, 3, 3))
    solution = Solution(
        START,
        position_ecef_m=np.array([4.2e6, 6e5, 4.7e6]),
        velocity_ecef_mps=rng.normal(size=3),
        velocity_cov_ecef_m2ps2=root[0] @ root[0].T,
        acceleration_ecef_mps2=rng.normal(size=3),
        acceleration_cov_ecef_m2ps4=root[1] @ root[1].T,
    )
    local = in_enu(solution)
    assert np.linalg.norm(local.velocity_mps) == pytest.approx(np.linalg.norm(solution.velocity_ecef_mps))
    np.testing.assert_allclose(local.rotation.T @ local.acceleration_mps2, solution.acceleration_ecef_mps2)
    assert np.trace(local.velocity_cov_m2ps2) == pytest.approx(np.trace(solution.velocity_cov_ecef_m2ps2))
    np.testing.assert_allclose(local.rotation.T @ local.acceleration_cov_m2ps4 @ local.rotation, solution.acceleration_cov_ecef_m2ps4)
    assert np.isnan(in_enu(replace(solution, position_ecef_m=np.full(3, nan))).velocity_mps).all()


@pytest.mark.slow
@pytest.mark.parametrize(("left", "status", "sure"), [
    (("G01", "G17", "G26", "G30", "G31"), Status.FIX, True),
    (("G01", "G17", "G26", "E02", "E19"), Status.FIX, False),
    (("G01", "G17", "G26", "G31"), Status.FLOAT, False),
])  # fmt: skip
def test_what_few_satellites_leave_of_a_sure_fix(
    scene: tuple[list, np.ndarray, np.ndarray], left: tuple[str, ...], status: Status, sure: bool
):
    """A house hides all others: of five one could object, of three beyond one per system none could, of four there is no fix."""
    kept = [satellite_number(name) for name in left]
    pairs = [(r.take(np.isin(r.satellite, kept)) if k >= 6 else r, b) for k, (r, b) in enumerate(scene[0])]
    before, last = solved((pairs, *scene[1:]), RtkOptions(systems="GE"))[5::2]
    assert (before.status, last.status) == (Status.FIX, status)
    assert before.fix_probability > 0.99
    if status is Status.FIX:
        assert (last.fix_probability > 1.0 - WRONG_NEAR) == sure
