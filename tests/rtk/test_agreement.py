"""Which fixes wait for a search that agrees with them."""

import pytest

from rtkmesh.rtk.agreement import CONFIRMED_LEAST, DEPARTURE_ALONE, note_fix, stands_alone
from rtkmesh.rtk.memory import CONFIRMED, HELD_SINCE_S, SINCE_SEARCH, UNAGREED, forget, new_memory


@pytest.fixture
def alone():
    """The memory of a filter that has had a fix at 100 s, confirmed often enough, and whose search now gives other integers."""
    memory = new_memory()
    memory[HELD_SINCE_S], memory[CONFIRMED], memory[SINCE_SEARCH], memory[UNAGREED] = 0.0, CONFIRMED_LEAST, 1.0, 1.0
    note_fix(memory, True, 100.0)
    return memory


def test_a_fix_that_was_confirmed_goes_on_alone(alone):
    assert not stands_alone(alone, 0.0, 101.0)
    assert not stands_alone(alone, DEPARTURE_ALONE, 101.0)


def test_a_fix_that_few_searches_gave_waits(alone):
    alone[CONFIRMED] = CONFIRMED_LEAST - 1.0
    assert stands_alone(alone, 0.0, 101.0)


def test_a_fix_that_leaves_the_prediction_waits(alone):
    assert stands_alone(alone, DEPARTURE_ALONE + 0.01, 101.0)


@pytest.mark.parametrize(
    ("epochs", "step_s", "waits"), [(2, 1.0, False), (3, 1.0, True), (1, 30.0, False), (3, 30.0, True), (9, 0.1, False), (40, 0.1, True)]
)
def test_a_fix_that_comes_back_waits(alone, epochs, step_s, waits):
    """After some epochs and seconds both: one lost minute of an epoch a minute is no absence, nor are ten epochs of a second."""
    for k in range(epochs):
        note_fix(alone, False, 100.0 + (k + 1) * step_s)
    assert stands_alone(alone, 0.0, 100.0 + (epochs + 1) * step_s) is waits
    note_fix(alone, True, 100.0 + (epochs + 1) * step_s)
    assert not stands_alone(alone, 0.0, 100.0 + (epochs + 2) * step_s)


def test_a_search_that_agrees_or_was_not_made_is_no_reason_to_wait(alone):
    """Whatever else: large sets that are sure are searched every few epochs only."""
    alone[CONFIRMED] = 0.0
    alone[SINCE_SEARCH] = 2.0
    assert not stands_alone(alone, 5.0, 200.0)
    alone[SINCE_SEARCH], alone[UNAGREED] = 1.0, 0.0
    assert not stands_alone(alone, 5.0, 200.0)


def test_new_integers_have_missed_nothing(alone):
    """Nothing of fixes before a release counts against what is found after it."""
    note_fix(alone, False, 150.0)
    forget(alone)
    alone[CONFIRMED], alone[UNAGREED], alone[SINCE_SEARCH] = CONFIRMED_LEAST, 1.0, 1.0
    assert not stands_alone(alone, 0.0, 300.0)
