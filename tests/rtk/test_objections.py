"""Which integers are not shown: few ones to which all satellites but one object."""

import numpy as np
import pytest
from tests.rtk.float_filters import GPS, TRUE, floating

from rtkmesh.rtk.acceptance import FAR_COUNT
from rtkmesh.rtk.ambiguity import Candidates, search
from rtkmesh.rtk.memory import ACCEPT_AT_ONCE, OBJECTION, SHOWN, new_memory, resolve_setup
from rtkmesh.rtk.objections import CLEARED, OBJECTED, OPEN, one_is_needed, weigh_objections
from rtkmesh.rtk.options import AmbiguityOptions
from rtkmesh.rtk.state import DYNAMIC, INTEGER
from rtkmesh.rtk.validation import FIX_OK, NOT_VALID, fix

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


def unclear(f, candidates):
    return search(f, candidates, np.nan, 0.01)._replace(odds=ACCEPT_AT_ONCE - 0.01)


@pytest.mark.parametrize("seed", range(4))
def test_one_satellite_must_not_be_all_that_speaks_for_integers(seed):
    f, gps = scene(seed=seed)
    assert one_is_needed(f, gps, SETUP)
    for reflected_cyc in (0.0, 0.5):
        assert not one_is_needed(*scene(np.zeros(GPS), seed, reflected_cyc), SETUP)


def weighed(memory, off_by=OTHERS, held=GPS - 1, setup=SETUP, free=unclear):
    f, gps = scene(off_by)
    weigh_objections(f, gps, held, free(f, gps), memory, setup)
    return memory[OBJECTION]


def clear(f, _):
    """A search that gives what is held with the odds of one search."""
    gps = Candidates(np.arange(1, GPS + 1), np.zeros(GPS, np.int64), f.keys[1 : GPS + 1], np.ones(GPS))
    return search(f, gps, np.nan, 0.01)._replace(values=f.history[:, INTEGER].copy(), odds=ACCEPT_AT_ONCE, resolved=True)


def test_an_objection_lasts_until_a_search_of_all_is_clear():
    memory = new_memory()
    assert weighed(memory, np.zeros(GPS)) == OPEN
    assert weighed(memory) == OBJECTED
    assert weighed(memory, np.zeros(GPS)) == OBJECTED
    assert weighed(memory, free=clear) == CLEARED
    assert weighed(memory) == CLEARED


def test_many_integers_and_known_lengths_are_not_asked():
    """Of many one satellite's are few, and odds by a known length are others."""
    assert weighed(new_memory(), held=FAR_COUNT) == OPEN
    assert weighed(new_memory(), setup=resolve_setup(AmbiguityOptions(), 1.0, 0.01)) == OPEN


@pytest.mark.parametrize(("objection", "reason"), [(OPEN, FIX_OK), (OBJECTED, NOT_VALID), (CLEARED, FIX_OK)])
def test_what_is_objected_to_is_not_shown(objection, reason):
    f, gps = scene(np.zeros(GPS), reflected_cyc=0.0)
    memory = new_memory()
    memory[SHOWN], memory[OBJECTION] = 1.0, objection
    assert fix(f, gps, unclear(f, gps), memory, SETUP, np.full(7, np.nan), 1.0, 0.5, False).reason == reason
