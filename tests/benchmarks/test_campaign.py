"""The campaign's own arithmetic: bounds, judgement, figures; and that every family runs and repeats itself."""

from types import SimpleNamespace

import numpy as np
import pytest

from rtkmesh.rtk.engine import Rtk

NAMES = ("bounds", "campaign", "families", "simulated", "dive", "heading")


@pytest.mark.parametrize(
    ("hits", "trials", "low", "high"),
    [(0, 10, 0.0, 0.3085), (10, 10, 0.6915, 1.0), (10, 100, 0.0490, 0.1762), (50, 100, 0.3983, 0.6017), (1, 1000, 2.53e-5, 5.56e-3)],
)
def test_bounds_of_clopper_and_pearson(benchmarks: SimpleNamespace, hits: int, trials: int, low: float, high: float):
    """Tabulated intervals of 95 %."""
    assert benchmarks.bounds.clopper_pearson(hits, trials) == pytest.approx((low, high), rel=2e-3, abs=1e-9)


@pytest.mark.parametrize(("hits", "trials"), [(0, 100_000), (7, 100_000), (99_000, 100_000)])
def test_bounds_of_many_trials_leave_out_the_tails_that_they_claim(benchmarks: SimpleNamespace, hits: int, trials: int):
    """At the upper bound `hits` or fewer have a probability of 2.5 %, summed term by term; and so at the lower."""
    from math import exp, lgamma, log, log1p

    def at_most(k: int, p: float) -> float:
        terms = (lgamma(trials + 1) - lgamma(i + 1) - lgamma(trials - i + 1) + i * log(p) + (trials - i) * log1p(-p) for i in range(k + 1))
        return sum(exp(term) for term in terms)

    low, high = benchmarks.bounds.clopper_pearson(hits, trials)
    assert at_most(hits, high) == pytest.approx(0.025, rel=1e-4)
    if hits:
        assert 1.0 - at_most(hits - 1, low) == pytest.approx(0.025, rel=1e-4)


def judged(benchmarks: SimpleNamespace, errors_m: list[float], status: list[int], possible: list[bool], doubt: float = 0.0) -> object:
    error = np.zeros((len(errors_m), 3))
    error[:, 2] = errors_m
    return benchmarks.simulated.Judged(np.array(status), error, np.array(errors_m) * 10.0, np.array(possible), np.full(len(status), doubt))


def test_a_failure_rate_leaves_what_is_as_sure(benchmarks: SimpleNamespace):
    """Fixes that are wrong with a higher probability are gone, and with them what is wrong among them."""
    sure = benchmarks.campaign.outcome("x", 0, judged(benchmarks, [0.0] * 30, [1] * 30, [True] * 30, 1e-3))
    doubtful = benchmarks.campaign.outcome("x", 1, judged(benchmarks, [1.0] * 10, [1] * 10, [True] * 10, 0.2))
    rows = {row["failure_rate"]: row for row in benchmarks.campaign.by_rate([sure, doubtful])}
    assert [(rows[r]["fix_pct"], rows[r]["wrong_fixes"], rows[r]["runs_with_wrong"]) for r in (1.0, 0.1, 1e-4)] == [
        (100.0, 10, 1), (75.0, 0, 0), (0.0, 0, 0),
    ]  # fmt: skip
    assert rows[1.0]["share"] == 0.25
    assert rows[0.1]["share_95"] == pytest.approx((0.0, 0.1157), abs=1e-4)


def test_outcomes_of_known_errors(benchmarks: SimpleNamespace):
    """Epochs without satellites do not count, floats are never wrong, the first right fix is timed from the first possible epoch."""
    run = judged(benchmarks, [9.0, 0.5, 0.2, 0.2, 0.1, 0.2, np.nan, 0.0], [1, 2, 1, 1, 1, 1, 0, 1], [False, *[True] * 7])
    found = benchmarks.campaign.outcome("x", 3, run)
    assert (found.possible, found.fixes, found.wrong, found.longest_wrong_s) == (7, 5, 3, 2)
    assert (found.first_right_s, found.worst_m) == (3.0, 0.2)
    assert found.fix_squares.tolist() == [2.0, 2.0, 1.0, 2.0, 0.0]
    assert found.float_squares.tolist() == [5.0]


def test_figures_of_two_runs(benchmarks: SimpleNamespace):
    """A run that never had a right fix is beyond every quantile that it reaches; runs and fixes are bounded apart."""
    good = benchmarks.campaign.outcome("x", 0, judged(benchmarks, [0.0] * 10, [1] * 10, [True] * 10))
    bad = benchmarks.campaign.outcome("x", 1, judged(benchmarks, [1.0] * 10, [1] * 10, [True] * 10))
    row = benchmarks.campaign.figures([good, bad])
    assert (row["fix_pct"], row["right_pct"], row["wrong_fixes"], row["runs_with_wrong"]) == (100.0, 50.0, 10, 1)
    assert row["wrong_pct_of_fixes_95"] == pytest.approx([27.2, 72.8], abs=0.05)
    assert row["runs_with_wrong_pct_95"] == pytest.approx([1.26, 98.74], abs=0.01)
    assert row["first_right_s"] == [None, None]
    assert benchmarks.campaign.figures([good, good, bad])["first_right_s"] == [0.0, None]


def test_a_run_is_the_same_every_time(benchmarks: SimpleNamespace):
    """Equal outcome to the last bit, whatever ran before; another seed gives another run."""
    first = benchmarks.campaign.measure("urban", 1, 2)
    benchmarks.campaign.measure("slips", 1, 0)
    again, other = benchmarks.campaign.measure("urban", 1, 2), benchmarks.campaign.measure("urban", 2, 2)
    assert first.fix_squares.tobytes() == again.fix_squares.tobytes()
    assert first.float_squares.tobytes() == again.float_squares.tobytes()
    assert first.fix_squares.tobytes() != other.fix_squares.tobytes()


@pytest.mark.parametrize(("family", "seed", "run"), [("slips_l1", 21, 12), ("open_m8_l1", 11, 3)])
def test_glonass_without_a_slope_does_not_mislead_for_long(benchmarks: SimpleNamespace, family: str, seed: int, run: int):
    """Runs on one band that were wrong for 79 and 56 s because GLONASS phases were assumed to have no slope."""
    assert benchmarks.campaign.measure(family, seed, run).longest_wrong_s <= 10


@pytest.mark.slow
def test_every_family_runs_and_is_possible(benchmarks: SimpleNamespace):
    """One run of each: there are epochs to fix, errors are known where there is a solution, a fault is really there."""
    for family in benchmarks.families.FAMILIES:
        rng = benchmarks.campaign.random_of(family, 1, 0)
        run = benchmarks.simulated.simulate(family.make(rng), rng)
        found = benchmarks.simulated.judge(run, benchmarks.simulated.solve(run))
        assert found.possible.sum() > 20, family.name
        solved = np.isin(found.status, (1, 2))
        assert np.isfinite(found.error_enu_m[solved]).all(), family.name
        assert solved.any(), family.name
        assert bool(run.disturbances) == (run.setup.faults is not None), family.name


def test_a_session_is_restarted_where_it_is_told(benchmarks: SimpleNamespace):
    """In the family of dives that are told, the same seed gives the same observations, and another solution after the dive."""
    by_name = {family.name: family for family in benchmarks.families.FAMILIES}
    rng = benchmarks.campaign.random_of(by_name["dive"], 1, 1)
    run = benchmarks.simulated.simulate(by_name["dive"].make(rng), rng)
    from dataclasses import replace

    told = replace(run, setup=replace(run.setup, told_restarts=True))
    first, second = ([s.resets if s else None for s in benchmarks.simulated.solve(r)] for r in (run, told))
    assert len(first) == len(second)
    positions = [benchmarks.simulated.judge(r, benchmarks.simulated.solve(r)).error_enu_m for r in (run, told)]
    assert np.array_equal(positions[0][:30], positions[1][:30], equal_nan=True)
    assert not np.array_equal(positions[0], positions[1], equal_nan=True)


# --- dives and headings ---


def test_surfacings_of_known_errors(benchmarks: SimpleNamespace):
    """Time counts from the first epoch with five satellites; wrong fixes are false, missing ones are neither."""

    def observed(satellites: int) -> object:
        return SimpleNamespace(epoch=SimpleNamespace(satellite=np.arange(satellites)))

    rover = [observed(k) for k in (9, 9, 0, 0, 3, 6, 6, 6, 6, 6)]
    mission = benchmarks.dive.Mission(SimpleNamespace(rover=rover), SimpleNamespace(), [(4, 10)])
    errors = np.array([0.0, 0.0, np.nan, np.nan, 0.0, np.nan, 3.0, 0.01, 0.2, 0.02])
    found = list(benchmarks.dive.surfacings(mission, errors))
    assert found == [benchmarks.dive.Surfacing(5, 2, 2, 2.0)]
    row = benchmarks.dive.figures(found)
    assert (row["right_pct"], row["false_fixes"], row["surfacings_with_false_pct"], row["never_fixed"]) == (40.0, 2, 100.0, 0)


def test_spread_of_known_headings(benchmarks: SimpleNamespace):
    """Half a degree either way around north, with one outlier of a metre that does not count."""
    azimuth = np.radians([359.5, 0.5] * 10)
    baseline = np.stack([np.sin(azimuth), np.cos(azimuth), np.zeros(20)], axis=1)
    row = benchmarks.heading.figures(np.vstack([baseline, [[1.0, 1.0, 0.0]]]), 42)
    assert (row["fix_pct"], row["outliers"]) == (50.0, 1)
    assert row["azimuth_sd_deg"] == pytest.approx(0.5)
    assert row["elevation_sd_deg"] == pytest.approx(0.0)
    assert row["length_sd_mm"] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.slow
def test_the_past_does_not_keep_the_integers_from_being_found(benchmarks: SimpleNamespace, monkeypatch: pytest.MonkeyPatch):
    """Run 15 of the streets: a float that reflected codes lead astray for most of the run, where one epoch by itself is clear."""
    family = next(f for f in benchmarks.families.FAMILIES if f.name == "urban")
    rng = benchmarks.campaign.random_of(family, 1, 15)
    run = benchmarks.simulated.simulate(family.make(rng), rng)
    found = benchmarks.simulated.judge(run, benchmarks.simulated.solve(run))
    monkeypatch.setattr(Rtk, "_may_begin_anew", lambda *_: False)
    alone = benchmarks.simulated.judge(run, benchmarks.simulated.solve(run))
    assert not found.wrong.any()
    assert found.fixed.sum() >= alone.fixed.sum() + 50
