"""Runs of the campaign at several rates: the same seconds, the same faults, every epoch solved."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from rtkmesh.rtk.options import AmbiguityMode

NAMES = ("rates", "campaign", "families", "simulated", "sigmas")


def test_rates_are_read(benchmarks: SimpleNamespace):
    """One number is for both receivers, two are rover and base."""
    assert benchmarks.rates.rates_of("1,5,10/1") == [benchmarks.campaign.Rates(1, 0), (5, 0), (10, 1)]


def test_a_run_is_the_same_at_other_rates(benchmarks: SimpleNamespace):
    """Five epochs a second of the rover, one of the base: the same place and span, slips at the same instants of the same kind."""
    family = next(f for f in benchmarks.families.FAMILIES if f.name == "slips")
    slow = benchmarks.campaign.simulated_run(family, 1, 0)
    fast = benchmarks.campaign.simulated_run(family, 1, 0, benchmarks.campaign.Rates(5, 1))
    assert (len(fast.rover), len(fast.base)) == (5 * len(slow.rover), len(slow.base))
    tags_s = [o.epoch.time - fast.start for o in fast.rover[:6]]
    assert tags_s == pytest.approx([0.0, 0.2, 0.4, 0.6, 0.8, 1.0], abs=1e-3)
    assert np.allclose(fast.baseline_ecef_m[::5], slow.baseline_ecef_m, atol=2e-3)  # clocks differ
    assert [(d.start_s, d.phase_cyc) for _, d in fast.disturbances] == [(d.start_s, d.phase_cyc) for _, d in slow.disturbances]


def test_every_epoch_of_a_fast_rover_is_solved(benchmarks: SimpleNamespace):
    """Ten epochs a second with a base that sends one: all have solutions, most are fixes; a base that shifts does so at its second."""
    family = next(f for f in benchmarks.families.FAMILIES if f.name == "base_shift")
    rng = benchmarks.campaign.random_of(family, 1, 0)
    setup = replace(family.make(rng), seconds=12, rate_hz=10, base_rate_hz=1, shift_at=6)
    run = benchmarks.simulated.simulate(setup, rng)
    solutions = benchmarks.simulated.solve(run)
    assert all(s is not None for s in solutions)
    found = benchmarks.simulated.judge(run, solutions)
    assert found.fixed.mean() > 0.9
    assert not found.wrong.any()


def test_outcomes_are_in_seconds(benchmarks: SimpleNamespace):
    """At 5 Hz ten wrong fixes in a row last for two seconds; the first right one is the eleventh epoch."""
    error = np.zeros((20, 3))
    error[:10, 0] = 1.0
    judged = benchmarks.simulated.Judged(np.ones(20, np.int64), error, np.ones(20), np.ones(20, np.bool_), np.zeros(20))
    found = benchmarks.campaign.outcome("x", 0, judged, 5)
    assert (found.wrong, found.longest_wrong_s, found.first_right_s) == (10, 2.0, 2.0)


def test_five_epochs_a_second_are_as_right_and_as_honest_as_one(benchmarks: SimpleNamespace):
    """Three runs of half a minute on one band: no fix is wrong, as many are right, and normalised squared errors of floats without
    integers are alike (as white noise, codes of five epochs a second made them several times larger).
    """
    family = next(f for f in benchmarks.families.FAMILIES if f.name == "open_f9p_l1")
    right, squares = list[float](), list[float]()
    for hz in (1, 5):
        runs = []
        for run in range(3):
            rng = benchmarks.campaign.random_of(family, 41, run)
            runs.append(benchmarks.simulated.simulate(replace(family.make(rng), seconds=30, rate_hz=hz), rng))
        found = [benchmarks.simulated.judge(run, benchmarks.simulated.solve(run)) for run in runs]
        assert not any(one.wrong.any() for one in found)
        right.append(float(np.mean([one.fixed.mean() for one in found])))
        squares.append(float(np.concatenate([benchmarks.sigmas.of_run(run, AmbiguityMode.OFF).squares() for run in runs]).mean()))
    assert right[1] == pytest.approx(right[0], abs=0.15)
    assert 0.5 < squares[1] / squares[0] < 2.0, squares
