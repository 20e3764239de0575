"""Signals in shade: which are, what tells reflections from trees, and what is put aside."""

from dataclasses import replace
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from rtkmesh.gnss.constants import SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.signals import KEYS_PER_SATELLITE
from rtkmesh.rtk.around import Past
from rtkmesh.rtk.asked_odds import at_least_street, is_street
from rtkmesh.rtk.matching import Pairs
from rtkmesh.rtk.memory import new_memory
from rtkmesh.rtk.noise import SHADE, new_code_scale
from rtkmesh.rtk.residuals import CODE, CODE_VARIANCE, DIFFERENCE, GAIN_DB, PHASE, PHASE_VARIANCE, WAVELENGTH, Differences
from rtkmesh.rtk.shade import ENOUGH, REFLECTED_CODE_M, SHADED_DOF, find_shaded, is_reflecting, leave_shade
from rtkmesh.rtk.state import HISTORY, INTEGER, Filter, new_filter
from rtkmesh.rtk.walk import no_walk

NAMES = ("campaign",)
MODEL_ECEF_M = np.array([4.0e6, 1.0e6, 4.8e6])
CODE_M = 0.8
WEAK_DB = 11.0
SEEN, HIDDEN = 7, 4  # satellites in the light and in shade


def epoch(seed, late_m=0.0, seen=SEEN, hidden=HIDDEN):
    """Return the differences of one signal of GPS satellites all over the sky; the last are weak, and late by so much on average."""
    rng, n = np.random.default_rng(seed), seen + hidden
    up, direction = MODEL_ECEF_M / np.linalg.norm(MODEL_ECEF_M), rng.normal(size=(n, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    direction = direction + (np.abs(direction @ up) - direction @ up)[:, None] * up  # above the horizon
    weak = np.arange(n) >= seen
    table = rng.normal(0.0, CODE_M, (n, DIFFERENCE))
    table[:, CODE] += 30.0 + np.where(weak, late_m * rng.uniform(0.5, 1.5, n), 0.0)
    table[:, CODE_VARIANCE], table[:, PHASE_VARIANCE] = CODE_M**2, 0.003**2
    table[:, WAVELENGTH] = SPEED_OF_LIGHT_MPS / 1575.42e6
    table[:, GAIN_DB] = rng.normal(-3.0, 0.5, n) - WEAK_DB * weak
    number, index, flags = np.arange(1, n + 1, dtype=np.int16), np.arange(n), np.zeros((n, 2), np.bool_)
    pairs = Pairs(number, index, index, np.zeros(n, np.int64), np.zeros(n, np.int64), 1, number.astype(np.int64) * KEYS_PER_SATELLITE)
    return Differences(pairs, table, direction, direction, np.zeros(n), flags, flags[:, 0].copy(), np.zeros((n, 2)), np.zeros(n))


def shaded(d):
    out = np.zeros(len(d.table), np.bool_)
    assert find_shaded(d, out) == out.sum()
    return out.tolist()


def told(late_m, epochs=20):
    """Return the memory of the noise after some epochs with such codes in shade."""
    scale = new_code_scale()
    for seed in range(epochs):
        leave_shade(new_filter(), epoch(seed, late_m), scale, MODEL_ECEF_M)
    return scale


def test_in_shade_is_what_a_quarter_of_its_group_outshines():
    d = epoch(0)
    assert shaded(d) == [False] * SEEN + [True] * HIDDEN
    d.table[:, GAIN_DB] += 20.0  # a better antenna than the base's
    assert shaded(d) == [False] * SEEN + [True] * HIDDEN
    d.table[0, GAIN_DB] = 60.0  # one that is heard better than any other is one
    assert shaded(d) == [False] * SEEN + [True] * HIDDEN


def test_signals_of_another_kind_are_no_weaker_for_that():
    """A group that the receivers hear otherwise is held against itself alone."""
    d = epoch(0)
    apart = d._replace(pairs=d.pairs._replace(group=np.repeat((0, 1), (SEEN, HIDDEN)), groups=2))
    assert not any(shaded(apart))


def test_nothing_is_in_shade_without_a_base_that_says_how_it_hears():
    d = epoch(0)
    d.table[:, GAIN_DB] = np.nan
    assert not any(shaded(d))
    d = epoch(0, seen=1, hidden=1)
    assert not any(shaded(d))


def test_codes_tell_walls_from_trees():
    """Weak signals whose codes are as good as their C/N0 says are right, late ones are reflections."""
    assert not is_reflecting(new_code_scale())
    assert not is_reflecting(told(0.0))
    assert is_reflecting(told(12.0))


def test_after_the_houses_trees_are_trees_again():
    scale = told(12.0)
    for seed in range(400):
        leave_shade(new_filter(), epoch(seed), scale, MODEL_ECEF_M)
    assert not is_reflecting(scale)


def test_reflections_are_put_aside():
    """Their codes say hardly anything; phases nothing, unless their integers are held. The others stay as they are."""
    scale, d = told(12.0), epoch(99, 12.0)
    keys, history = d.pairs.key[SEEN : SEEN + 2].copy(), np.full((2, HISTORY), np.nan)
    history[0, INTEGER] = 7.0
    f, before = Filter(*new_filter()[:2], keys, history), d.table.copy()
    assert leave_shade(f, d, scale, MODEL_ECEF_M)
    before[SEEN:, CODE_VARIANCE] += REFLECTED_CODE_M**2
    before[SEEN + 1 :, PHASE] = np.nan
    assert d.table == pytest.approx(before, nan_ok=True)


@pytest.mark.parametrize(("seen", "aside"), [(ENOUGH, True), (ENOUGH - 1, False)])
def test_where_too_few_are_left_nothing_is_put_aside(seen, aside):
    d = epoch(99, 12.0, seen)
    before = d.table.copy()
    assert leave_shade(new_filter(), d, told(12.0), MODEL_ECEF_M) == aside
    assert np.array_equal(d.table, before, equal_nan=True) != aside


def test_the_place_stays_a_street_when_its_codes_are_gone():
    assert is_street(at_least_street(0.3))
    assert at_least_street(50.0) == 50.0
    assert not is_street(at_least_street(np.inf))


def test_ten_epochs_of_a_second_tell_of_shade_as_one():
    past = Past(new_memory(), np.full(7, np.nan), told(0.0, 1), new_code_scale(), no_walk())
    before, at_once = past.learned(0.1), past.scale[SHADE, SHADED_DOF]
    leave_shade(new_filter(), epoch(5), past.scale, MODEL_ECEF_M)
    past.count_in_part(before, 0.1)
    assert past.scale[SHADE, SHADED_DOF] - at_once == pytest.approx(HIDDEN / 9.0)


@pytest.fixture(scope="module")
def campaign(benchmarks: SimpleNamespace) -> ModuleType:
    """The module that draws runs of families."""
    return benchmarks.campaign


@pytest.mark.slow  # without compiled kernels
@pytest.mark.parametrize("number", [5, 11])
def test_streets_have_fixes_that_reflections_kept_away(campaign: ModuleType, number: int):
    """The same run has fewer right ones where the base does not say how well it hears."""
    (family,) = campaign.named("urban")
    run = campaign.simulated_run(family, 1, number)
    deaf = replace(run, base_epochs=[e if e is None else replace(e, cn0_dbhz=np.full(len(e.satellite), np.nan)) for e in run.base_epochs])
    found, without = (campaign.judge(one, campaign.solve(one)) for one in (run, deaf))
    assert not found.wrong.any()
    assert found.fixed.sum() >= without.fixed.sum() + 8
