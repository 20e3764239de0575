"""The filter that is told the integers: what it does to differences, to ambiguities and how it judges an atmosphere."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtkmesh.gnss.signals import KEYS_PER_SATELLITE
from rtkmesh.rtk import informed
from rtkmesh.rtk.ambiguity import held_differences, tell
from rtkmesh.rtk.bookkeeping import relax
from rtkmesh.rtk.matching import Pairs
from rtkmesh.rtk.memory import DOUBTS, INFORMED, SHOWN, new_memory
from rtkmesh.rtk.residuals import (
    CODE,
    CODE_VARIANCE,
    DIFFERENCE,
    ELEVATION_RAD,
    GLONASS_CODE_M,
    PHASE,
    PHASE_VARIANCE,
    Differences,
    blur_glonass_codes,
)
from rtkmesh.rtk.state import DYNAMIC, HISTORY, INTEGER, USUAL_M, ZENITH_KEY, Filter
from rtkmesh.rtk.validation import RELEASE_EPOCHS, note


def differences(satellites, seed=0):
    """Return differences of one signal of these satellites, above 20 degrees."""
    rng, n = np.random.default_rng(seed), len(satellites)
    table = rng.normal(size=(n, DIFFERENCE))
    table[:, ELEVATION_RAD], table[:, CODE_VARIANCE], table[:, PHASE_VARIANCE] = rng.uniform(0.4, 1.5, n), 1.0, 1.0
    direction = rng.normal(size=(n, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    number, index, flags = np.array(satellites, np.int16), np.zeros(n, np.int64), np.zeros((n, 2), np.bool_)
    pairs = Pairs(number, index, index, index, index, 1, number.astype(np.int64) * KEYS_PER_SATELLITE)
    return Differences(pairs, table, direction, direction, np.zeros(n), flags, flags[:, 0].copy(), np.zeros((n, 2)), np.zeros(n))


def told_filter(integers, seed=1):
    """Return a filter of one group's ambiguities that holds these integers and is off them by some cycles."""
    n = DYNAMIC + len(integers)
    A = np.random.default_rng(seed).normal(size=(n, n))
    keys, history = np.arange(1, len(integers) + 1) * KEYS_PER_SATELLITE, np.zeros((len(integers), HISTORY))
    history[:, INTEGER] = integers
    return Filter(np.random.default_rng(seed + 1).normal(size=n), A @ A.T + np.eye(n), keys.astype(np.int64), history)


@given(st.lists(st.floats(-2.0, 2.0), min_size=3, max_size=3), st.integers(0, 99))
def test_a_longer_baseline_brings_nearer_what_lies_ahead(shift, seed):
    """Observed minus modelled grows by the shift's part towards the satellite, code and phase alike; there and back changes nothing."""
    d, shift = differences([1, 2, 3, 70], seed), np.array(shift)
    there = informed.with_states(d, shift)
    expected = d.rover_direction @ shift
    assert there.table[:, CODE] - d.table[:, CODE] == pytest.approx(expected, abs=1e-12)
    assert there.table[:, PHASE] - d.table[:, PHASE] == pytest.approx(expected, abs=1e-12)
    back = informed.with_states(there, -shift)
    assert back.table[:, PHASE] == pytest.approx(d.table[:, PHASE], abs=1e-12)


def test_glonass_codes_say_nothing():
    """They get metres; phases and the codes of others stay as they are."""
    d = differences([1, 2, 70])
    before = d.table.copy()
    blur_glonass_codes(d)
    before[2, CODE_VARIANCE] += GLONASS_CODE_M**2
    assert d.table == pytest.approx(before, nan_ok=True)


def test_what_is_told_is_known():
    """The differences of ambiguities are the integers within the variance of telling; the filter stays positive definite."""
    f = told_filter(np.array([4.0, -7.0, 11.0, 2.0, 5.0]))
    held = np.array([[DYNAMIC + k, DYNAMIC] for k in range(1, 5)])
    tell(f, held, held_differences(f, held), 0.01**2)
    assert [f.x[i] - f.x[r] for i, r in held] == pytest.approx(held_differences(f, held), abs=0.01)
    assert np.linalg.eigvalsh(f.P).min() > 0.0
    assert all(f.P[i, i] + f.P[r, r] - 2.0 * f.P[i, r] < 0.0101**2 for i, r in held)


def atmosphere(satellites, held):
    """Return a filter with a zenith delay, an ionosphere per satellite, and two ambiguities of each, held as said."""
    keys = np.array([ZENITH_KEY, *satellites, *(s * KEYS_PER_SATELLITE + b for s in satellites for b in (1, 2))], np.int64)
    n, history = len(keys), np.full((len(keys), HISTORY), np.nan)
    history[1 + len(satellites) :, INTEGER] = np.repeat(np.where(held, 5.0, np.nan), 2)
    return Filter(np.zeros(DYNAMIC + n), np.eye(DYNAMIC + n), keys, history)


@given(st.floats(-5.0, 5.0), st.floats(-5.0, 5.0))
def test_what_a_system_shares_is_no_strain(first, second):
    """A common ionosphere of a system is part of its clocks; one of 16 cm in the zenith is a strain of ten."""
    f = atmosphere([3, 7, 9, 130, 133], [True] * 5)
    f.x[DYNAMIC + 1 : DYNAMIC + 4], f.x[DYNAMIC + 4 : DYNAMIC + 6] = first, second
    assert informed.strain(f, 30e3) == pytest.approx(0.0, abs=1e-9)
    f.x[DYNAMIC + 1] += 0.3
    assert informed.strain(f, 30e3) == pytest.approx(0.3 * np.sqrt(2.0 / 3.0 / 5.0) / 0.068, rel=1e-6)
    f.x[DYNAMIC] = -0.16
    assert informed.strain(f, 30e3) == pytest.approx(10.0)


def test_only_satellites_with_integers_strain():
    """An ionosphere that is known by codes and float ambiguities says nothing of integers."""
    f = atmosphere([3, 7, 9], [True, True, False])
    f.x[DYNAMIC + 3] = 1.0
    assert informed.strain(f, 30e3) == 0.0


def strained(f, strains):
    """Return, for epochs with these strains in which the witness has no doubt of its own, whether integers are held and in doubt; and what
    the informed filter is said to have found.
    """
    memory, prediction, seen = new_memory(), np.zeros(7), []
    memory[SHOWN] = 1.0
    for strain in strains:
        note(f, False, memory, prediction)
        informed.note_strain(f, strain, memory, prediction)
        seen.append((bool(np.isfinite(f.history[:, INTEGER]).any()), memory[DOUBTS] > 0.0 or memory[SHOWN] == 0.0))
    return seen, memory[INFORMED]


@pytest.mark.parametrize("strain", [1.01, np.inf, np.nan])
def test_what_strains_the_atmosphere_is_hidden_and_released_in_the_end(strain):
    seen, _ = strained(atmosphere([3, 7, 9], [True] * 3), [0.5, *[strain] * RELEASE_EPOCHS])
    assert seen == [(True, False), *[(True, True)] * (RELEASE_EPOCHS - 1), (False, True)]


def test_what_strains_it_now_and_then_is_held_and_shown_when_it_does_not():
    strains = ([1.2] * (RELEASE_EPOCHS - 1) + [0.9]) * 5
    seen, agreed = strained(atmosphere([3, 7, 9], [True] * 3), strains)
    assert seen == [(True, strain > 1.0) for strain in strains]
    assert agreed == 0.0
    assert strained(atmosphere([3, 7, 9], [True] * 3), [1.2, 0.5, 0.6])[1] == 2.0


@given(st.floats(0.1, 3.0), st.floats(10.0, 3000.0))
def test_ionospheres_go_back_to_what_is_usual(memories, usual_mm):
    """A Gauss-Markov process: what was known fades with the memory, the variance becomes the usual one; nothing else changes."""
    f, memory_s, usual_m = atmosphere([3, 7], [True, True]), 600.0, usual_mm * 1e-3
    n = len(f.x)
    A = np.random.default_rng(2).normal(size=(n, n))
    f.P[:, :], f.x[:], f.history[1:3, USUAL_M] = A @ A.T, np.arange(1.0, n + 1.0), usual_m
    x, P, ionospheres = f.x.copy(), f.P.copy(), slice(DYNAMIC + 1, DYNAMIC + 3)
    for _ in range(10):
        relax(f, memory_s, memories * memory_s / 10.0)
    keep = np.ones(n)
    keep[ionospheres] = np.exp(-memories)
    added = np.zeros(n)
    added[ionospheres] = (1.0 - np.exp(-2.0 * memories)) * usual_m**2
    assert f.x == pytest.approx(x * keep)
    np.testing.assert_allclose(f.P, np.outer(keep, keep) * P + np.diag(added), rtol=1e-9, atol=1e-12)


def test_integers_are_adopted_by_key():
    """Only keys that both have, and only integers that the witness holds; what it does not know stays."""
    f, witness = told_filter(np.array([1.0, 2.0, 3.0])), told_filter(np.array([5.0, np.nan, 9.0]))
    informed.adopt(f, witness._replace(keys=np.array([1, 2, 4], np.int64) * KEYS_PER_SATELLITE))
    assert f.history[:, INTEGER].tolist() == [5.0, 2.0, 3.0]
