"""Which fixes wait for a search that agrees with them."""

import pytest

from rtkmesh.rtk.agreement import (
    AGREED_LEAST_S,
    DEPARTURE_ALONE,
    FAINT_ODDS,
    FEW_INTEGERS,
    LONE_FIT,
    LONE_LEAST_S,
    PROOF_ODDS,
    PROVEN_LEAST_S,
    is_left_alone,
    is_unsafe,
    note_fix,
    note_proof,
    stands_alone,
)
from rtkmesh.rtk.asked_odds import MIRRORED_CODES, WEAK_COUNT
from rtkmesh.rtk.memory import AGREED_S, CONFIRMED, HELD_SINCE_S, LONE_S, PROVEN_S, SINCE_SEARCH, UNAGREED, forget, new_memory


@pytest.fixture
def alone():
    """The memory of a filter that has had a fix at 100 s, confirmed often enough, and whose search now gives other integers."""
    memory = new_memory()
    memory[HELD_SINCE_S], memory[AGREED_S], memory[SINCE_SEARCH], memory[UNAGREED] = 0.0, AGREED_LEAST_S, 1.0, 1.0
    note_fix(memory, True, 100.0)
    return memory


def test_a_fix_that_was_confirmed_goes_on_alone(alone):
    assert not stands_alone(alone, 0.0, 101.0, False, 9.0)
    assert not stands_alone(alone, DEPARTURE_ALONE, 101.0, False, 9.0)


def test_a_fix_that_few_searches_gave_waits(alone):
    alone[AGREED_S] = AGREED_LEAST_S - 1.0
    assert stands_alone(alone, 0.0, 101.0, False, 9.0)


def test_a_fix_that_leaves_the_prediction_waits(alone):
    assert stands_alone(alone, DEPARTURE_ALONE + 0.01, 101.0, False, 9.0)


@pytest.mark.parametrize(
    ("epochs", "step_s", "waits"), [(2, 1.0, False), (3, 1.0, True), (1, 30.0, False), (3, 30.0, True), (9, 0.1, False), (40, 0.1, True)]
)
def test_a_fix_that_comes_back_waits(alone, epochs, step_s, waits):
    """After some epochs and seconds both: one lost minute of an epoch a minute is no absence, nor are ten epochs of a second."""
    for k in range(epochs):
        note_fix(alone, False, 100.0 + (k + 1) * step_s)
    assert stands_alone(alone, 0.0, 100.0 + (epochs + 1) * step_s, False, 9.0) is waits
    note_fix(alone, True, 100.0 + (epochs + 1) * step_s)
    assert not stands_alone(alone, 0.0, 100.0 + (epochs + 2) * step_s, False, 9.0)


def test_a_search_that_agrees_or_was_not_made_is_no_reason_to_wait(alone):
    """Whatever else: large sets that are sure are searched every few epochs only."""
    alone[AGREED_S] = 0.0
    alone[SINCE_SEARCH] = 2.0
    assert not stands_alone(alone, 5.0, 200.0, False, 9.0)
    alone[SINCE_SEARCH], alone[UNAGREED] = 1.0, 0.0
    assert not stands_alone(alone, 5.0, 200.0, False, 9.0)


def test_new_integers_have_missed_nothing(alone):
    """Nothing of fixes before a release counts against what is found after it."""
    note_fix(alone, False, 150.0)
    forget(alone)
    alone[AGREED_S], alone[UNAGREED], alone[SINCE_SEARCH] = AGREED_LEAST_S, 1.0, 1.0
    assert not stands_alone(alone, 0.0, 300.0, False, 9.0)


@pytest.fixture
def agreed():
    """The memory of a filter that holds integers since 0 s, given by the search of 1 s, with a fix then."""
    memory = new_memory()
    memory[HELD_SINCE_S], memory[SINCE_SEARCH] = 0.0, 1.0
    note_proof(memory, 0.0, 9.0, 0.0)
    note_fix(memory, True, 1.0)
    return memory


def prove(memory, odds, step_s, epochs, start_s=0.0):
    """Searches in a row that give what is held, with these log odds."""
    for k in range(epochs):
        memory[CONFIRMED] += 1.0
        note_proof(memory, memory[CONFIRMED] - 1.0, odds, start_s + (k + 1) * step_s)


@pytest.mark.parametrize(("step_s", "epochs", "agreed_s"), [(1.0, 3, 3.0), (0.1, 29, 2.9), (0.1, 3, 0.3), (30.0, 3, 3.0)])
def test_agreement_counts_by_the_second(agreed, step_s, epochs, agreed_s):
    """At 10 Hz three searches in a row have the errors of one; an epoch a minute is one all the same."""
    prove(agreed, PROOF_ODDS - 0.1, step_s, epochs)
    assert agreed[AGREED_S] == pytest.approx(agreed_s)
    assert agreed[PROVEN_S] == 0.0


def test_a_search_that_gives_others_is_no_agreement(agreed):
    note_proof(agreed, agreed[CONFIRMED], 9.0, 1.0)
    assert agreed[AGREED_S] == agreed[PROVEN_S] == 0.0


def test_integers_that_must_be_proven_wait_for_clear_searches(agreed):
    """A search that gives them faintly says nothing; a clearer one is shown at once, and those that follow after proof all."""
    assert stands_alone(agreed, 0.0, 1.0, True, FAINT_ODDS - 0.1)
    assert not stands_alone(agreed, 0.0, 1.0, True, FAINT_ODDS)
    assert not stands_alone(agreed, 0.0, 1.0, False, FAINT_ODDS - 0.1)
    prove(agreed, PROOF_ODDS, 1.0, 4)
    assert stands_alone(agreed, 0.0, 5.0, True, FAINT_ODDS - 0.1)
    prove(agreed, PROOF_ODDS, 1.0, 1, 4.0)
    assert not stands_alone(agreed, 0.0, 6.0, True, FAINT_ODDS - 0.1)


def test_what_is_not_proven_does_not_stand_alone(agreed):
    """Given often enough to be shown alone elsewhere, but never clearly."""
    prove(agreed, PROOF_ODDS - 0.1, 1.0, 5)
    agreed[UNAGREED] = 1.0
    assert stands_alone(agreed, 0.0, 6.0, True, 9.0)
    assert not stands_alone(agreed, 0.0, 6.0, False, 9.0)


def test_new_integers_are_shown_in_their_own_epoch_and_have_no_proof(agreed):
    prove(agreed, PROOF_ODDS, 1.0, 6)
    agreed[HELD_SINCE_S] = 7.0
    note_proof(agreed, agreed[CONFIRMED], 9.0, 7.0)
    assert agreed[PROVEN_S] == agreed[AGREED_S] == 0.0
    assert not stands_alone(agreed, 0.0, 7.0, True, 0.0)


def test_proof_is_forgotten_while_there_is_no_fix(agreed):
    """Integers that come back must be given clearly again: the satellites that spoke for them may be gone."""
    prove(agreed, PROOF_ODDS, 1.0, 6)
    note_fix(agreed, True, 6.0)
    for time_s in (7.0, 8.0):
        note_fix(agreed, False, time_s)
    assert agreed[PROVEN_S] >= PROVEN_LEAST_S
    for time_s in (9.0, 10.0):
        note_fix(agreed, False, time_s)
    assert agreed[PROVEN_S] == 0.0
    assert stands_alone(agreed, 0.0, 11.0, True, FAINT_ODDS - 0.1)


def test_few_integers_with_reflected_codes_must_be_proven():
    assert is_unsafe(FEW_INTEGERS, MIRRORED_CODES + 0.1)
    assert not is_unsafe(FEW_INTEGERS + 1, MIRRORED_CODES + 0.1)
    assert not is_unsafe(FEW_INTEGERS, MIRRORED_CODES)
    assert not is_unsafe(FEW_INTEGERS, float("inf"))


@pytest.mark.parametrize(
    ("integers", "misfit", "waits"), [(WEAK_COUNT - 1, 1.01, True), (WEAK_COUNT - 1, 0.99, False), (WEAK_COUNT, 3.0, False)]
)
def test_few_integers_that_stay_alone_must_fit(alone, integers, misfit, waits):
    alone[LONE_S] = LONE_LEAST_S
    assert is_left_alone(alone, integers, misfit * LONE_FIT) is waits


def test_integers_that_were_given_a_moment_ago_may_fit_badly(alone):
    """Nor are those asked whose search was not made."""
    alone[LONE_S] = LONE_LEAST_S - 0.1
    assert not is_left_alone(alone, 5, 2.0 * LONE_FIT)
    alone[LONE_S], alone[SINCE_SEARCH] = 2.0 * LONE_LEAST_S, 2.0
    assert not is_left_alone(alone, 5, 2.0 * LONE_FIT)


def test_searches_that_do_not_agree_leave_it_alone(alone):
    """For as long as they do not, an epoch for a second at most; one that agrees ends it, and so do new integers."""
    note_proof(alone, 0.0, 9.0, 100.0)
    for k in range(3):
        note_proof(alone, alone[CONFIRMED], 9.0, 101.0 + k)
    note_proof(alone, alone[CONFIRMED], 9.0, 133.0)
    assert alone[LONE_S] == pytest.approx(5.0)
    alone[CONFIRMED] += 1.0
    note_proof(alone, alone[CONFIRMED] - 1.0, 0.0, 134.0)
    assert alone[LONE_S] == 0.0
    note_proof(alone, alone[CONFIRMED], 0.0, 135.0)
    alone[HELD_SINCE_S] = 136.0
    note_proof(alone, alone[CONFIRMED], 0.0, 136.0)
    assert alone[LONE_S] == 0.0
