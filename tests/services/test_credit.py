"""A replay waits for its consumers, and only for those that live."""

import threading

from rtkmesh.gnss.time import GpsTime
from rtkmesh_schemas.observation import Credit
from rtkmesh_services.ingest.credit import CreditGate

T = GpsTime(2300, 100.0)


def passes(gate: CreditGate, sequence: int, time: GpsTime = T) -> bool:
    """Whether a message may be sent now: the gate's thread is given a process that ends as soon as it has waited once."""
    return gate.wait(sequence, time, Ending())


class Ending(threading.Event):
    """Of a process that is asked to end while the gate looks for the first time."""

    def is_set(self) -> bool:
        before = super().is_set()
        self.set()
        return before


def credit(name: str, sequence: int, start_id: str = "s1", wanted: GpsTime | None = None) -> Credit:
    until = None if wanted is None else (wanted.week, wanted.tow_s)
    return Credit(consumer=name, consumer_start_id=start_id, sequence=sequence, wanted=until)


def test_it_begins_when_all_consumers_have_spoken() -> None:
    gate, ending = CreditGate(["a", "b"]), threading.Event()
    gate.credit(credit("a", -1))
    gate.credit(credit("stranger", -1))
    assert gate.missing() == ["b"]
    ready = threading.Thread(target=lambda: gate.wait_ready(ending) and done.set())
    done = threading.Event()
    ready.start()
    gate.credit(credit("b", -1))
    ready.join(60.0)
    assert done.is_set()


def test_it_is_never_further_ahead_than_the_window_of_the_slowest() -> None:
    gate = CreditGate(["a", "b"], window=4)
    gate.credit(credit("a", 100))
    gate.credit(credit("b", -1))
    assert passes(gate, 3)
    assert not passes(gate, 4)
    gate.credit(credit("b", 2))
    assert passes(gate, 6)


def test_a_consumer_that_needs_a_later_time_gets_it_beyond_the_window() -> None:
    gate = CreditGate(["a"], window=2)
    gate.credit(credit("a", -1, wanted=T + 5.0))
    assert passes(gate, 50, T + 4.0)
    assert not passes(gate, 51, T + 6.0)


def test_a_dead_consumer_is_not_waited_for_and_counts_from_its_return() -> None:
    gate = CreditGate(["a"], window=2)
    gate.credit(credit("a", -1))
    gate.gone("a")
    assert passes(gate, 70)
    gate.credit(credit("a", -1, start_id="s2"))
    assert passes(gate, 72)
    assert not passes(gate, 73)


def test_without_consumers_nothing_waits() -> None:
    gate, ending = CreditGate([]), threading.Event()
    assert gate.wait_ready(ending)
    assert passes(gate, 10_000)
