"""Which integers are not shown: few ones to which all satellites but one object."""

import numpy as np
import pytest
from tests.rtk.float_filters import GPS, TRUE, floating

from rtkmesh.rtk.acceptance import FAR_COUNT
from rtkmesh.rtk.ambiguity import Candidates, search
from rtkmesh.rtk.memory import ACCEPT_AFTER_STREAK, ACCEPT_AT_ONCE, CONFIRMED, HELD_SINCE_S, OBJECTED, SHOWN, new_memory, resolve_setup
from rtkmesh.rtk.objections import hear_objections, one_is_needed
from rtkmesh.rtk.options import AmbiguityOptions
from rtkmesh.rtk.state import DYNAMIC, INTEGER
from rtkmesh.rtk.validation import CONFIRMATIONS, decide

SETUP = resolve_setup(AmbiguityOptions(), None, 0.01)
OFF = GPS - 1  # the satellite whose phase is a reflected one
OTHERS = np.concatenate([[1], np.zeros(OFF - 1), [2]])


def scene(off_by=OTHERS, seed=0, reflected_cyc=0.5):
    """A float filter with the phase of one satellite off, its GPS candidates, and integers that are held ``off_by`` the true ones."""
    f, everything = floating(np.random.default_rng(seed), code_m=0.1)
    f.x[DYNAMIC + 1 + OFF] += reflected_cyc
    f.history[:, INTEGER] = np.nan
    f.history[1 : GPS + 1, INTEGER] = TRUE[:GPS] + off_by
    return f, Candidates(*(column[:GPS] for column in everything))


@pytest.mark.parametrize("seed", range(4))
def test_one_satellite_must_not_be_all_that_speaks_for_integers(seed):
    f, gps = scene(seed=seed)
    assert one_is_needed(f, gps, SETUP)
    for reflected_cyc in (0.0, 0.5):
        assert not one_is_needed(*scene(np.zeros(GPS), seed, reflected_cyc), SETUP)


def heard(memory, off_by=OTHERS, held=GPS - 1, setup=SETUP):
    f, gps = scene(off_by)
    hear_objections(f, gps, held, memory, setup)
    return memory[OBJECTED] > 0.0


def test_an_objection_to_what_was_not_shown_is_remembered():
    memory = new_memory()
    assert not heard(memory, np.zeros(GPS))
    assert heard(memory)
    assert heard(memory, np.zeros(GPS))


def test_what_was_shown_many_integers_and_known_lengths_are_not_asked():
    """Of many one satellite's are few, and odds by a known length are others."""
    memory = new_memory()
    memory[SHOWN] = 1.0
    assert not heard(memory)
    assert not heard(new_memory(), held=FAR_COUNT)
    assert not heard(new_memory(), setup=resolve_setup(AmbiguityOptions(), 1.0, 0.01))


@pytest.mark.parametrize(("objected", "level", "least"), [
    (0.0, 0.5, ACCEPT_AFTER_STREAK), (1.0, 0.5, ACCEPT_AT_ONCE), (0.0, 2.0, ACCEPT_AFTER_STREAK), (1.0, 2.0, ACCEPT_AT_ONCE),
])  # fmt: skip
def test_what_was_objected_to_is_shown_by_the_odds_of_one_search(objected, level, least):
    """Searches that agree have confirmed it often enough; of those one must be as clear as a first one."""
    shown = 0
    for seed in range(24):
        f, everything = floating(np.random.default_rng(seed), code_m=0.3, phase_m=0.005)
        gps, memory = Candidates(*(column[:GPS] for column in everything)), new_memory()
        free = search(f, gps, np.nan, 0.01)
        f.history[:, INTEGER] = free.values
        memory[CONFIRMED], memory[OBJECTED], memory[HELD_SINCE_S] = CONFIRMATIONS, objected, 0.0
        decide(f, gps, memory, SETUP, np.full(7, np.nan), 1.0, level)
        if memory[OBJECTED] == objected:  # else it was objected to just now
            assert (memory[SHOWN] > 0.0) == (free.odds >= least)
            shown += memory[SHOWN] > 0.0
    assert 0 < shown < 24
