"""The contract of the bus, kept by the real one and by its twin in memory alike."""

import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from rtkmesh_schemas.command import Request
from rtkmesh_schemas.keys import CMD, CREDIT, EPH, OBS, RAW, SOL_TEXT, STATUS
from rtkmesh_schemas.status import ServiceStatus, State
from rtkmesh_schemas.wire import decode, encoding_of
from rtkmesh_services.errors import BusError
from rtkmesh_services.runtime.bus import Answer, Bus, Liveliness, Query, Sample, endpoints_for
from rtkmesh_services.runtime.inbox import Inbox
from rtkmesh_services.runtime.memory_bus import MemoryBus, MemoryNetwork, matches
from rtkmesh_services.runtime.zenoh_bus import history_depth, open_bus, open_router, router_config

Make = Callable[[str], Bus]


@pytest.fixture(params=["memory", "zenoh"])
def make(request: pytest.FixtureRequest) -> Iterator[Make]:
    """A function that connects a process to the network of this test."""
    if request.param == "memory":
        network = MemoryNetwork()
        yield lambda name: MemoryBus(name, network)
        return
    hub, endpoint = request.getfixturevalue("zenoh_hub")
    opened: list[Bus] = []

    def connect(name: str) -> Bus:
        opened.append(open_bus(name, [endpoint], timeout_s=5.0))
        return opened[-1]

    yield connect
    for bus in opened:
        bus.close()
    assert hub.counters["callback_errors"] == 0


@pytest.fixture(scope="module")
def zenoh_hub(free_port: Callable[[], int]) -> Iterator[tuple[Bus, str]]:
    """A hub inside the test's process."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with open_router("hub", router_config(listen=[endpoint])) as hub:
        yield hub, endpoint


def attach(subscriber: Bus, publisher: Bus, expression: str, **options: Any) -> Inbox:
    """Subscribe and wait until the publisher's messages would come: what was declared before on the same link stands."""
    inbox, ready = Inbox(), threading.Event()
    subscriber.subscribe(expression, inbox.put, **options)
    handle = publisher.subscribe("rtk/ready/credit", lambda sample: ready.set() if sample.payload == b"x" else None)
    for _ in range(100):
        subscriber.publish_as("ready", CREDIT, b"x")
        if ready.wait(0.05):
            break
    handle.close()
    assert ready.is_set()
    return inbox


def test_a_message_arrives_with_encoding_attachment_and_time(make: Make):
    """Structs as msgpack with their name, bytes and text as such."""
    sender, receiver = make("a"), make("b")
    inbox = attach(receiver, sender, "rtk/*/raw/*")
    sender.publish(RAW, b"\xb5\x62", attachment=b"12", protocol="ubx")
    sample = inbox.get(5.0)
    assert (sample.key, sample.payload) == ("rtk/a/raw/ubx", b"\xb5\x62")
    assert (sample.encoding, sample.attachment) == ("application/octet-stream", b"12")
    assert sample.received_mono_ns > 0
    texts = attach(receiver, sender, "rtk/a/sol/llh")
    sender.publish(SOL_TEXT, "ü", format="llh")
    assert (texts.get(5.0).payload.decode(), sender.counters["published"]) == ("ü", 2)
    status = ServiceStatus(id="a", role="hub", state=State.RUNNING, start_id="s", heartbeat=1)
    states = attach(receiver, sender, STATUS.expression(), history=True)
    sender.publish(STATUS, status)
    got = states.get(5.0)
    assert got.encoding == encoding_of(ServiceStatus)
    assert decode(ServiceStatus, got.payload, got.encoding) == status
    assert sender.newest(STATUS) == (got.payload, got.encoding)
    assert sender.newest(OBS) is None


def test_cached_messages_come_to_late_joiners_up_to_their_depth(make: Make):
    """History first, then what is new; plain subscribers get only the new. Late is who joins after the hub has passed the messages on."""
    sender, witness, late = make("a"), make("w"), make("b")
    passed = attach(witness, sender, "rtk/a/eph/*")
    for number in range(3):
        sender.publish(EPH, f"G01 {number}", satellite="G01")
    sender.publish(EPH, "E05 0", satellite="E05")
    assert [passed.get(5.0).payload for _ in range(4)][-1] == b"E05 0"
    inbox = attach(late, sender, "rtk/a/eph/*", history=True)
    plain = attach(late, sender, "rtk/a/eph/*")
    got = [inbox.get(5.0).payload.decode() for _ in range(3)]
    assert sorted(got) == ["E05 0", "G01 1", "G01 2"]
    sender.publish(EPH, "G01 3", satellite="G01")
    assert inbox.get(5.0).payload == b"G01 3"
    assert plain.get(5.0).payload == b"G01 3"


def test_a_joiner_misses_nothing_of_the_depth_while_messages_are_on_their_way(make: Make):
    """Who joins while messages travel gets the newest of the depth, and what reaches it live: no gap, no message twice, all in order."""
    sender, joiner = make("a"), make("b")
    for number in range(3):
        sender.publish(EPH, f"{number}", satellite="G01")
    inbox = attach(joiner, sender, "rtk/a/eph/*", history=True)
    sender.publish(EPH, "3", satellite="G01")
    got: list[int] = []
    while not got or got[-1] != 3:
        got.append(int(inbox.get(5.0).payload))
    assert got in ([2, 3], [1, 2, 3], [0, 1, 2, 3])


@pytest.mark.parametrize(
    ("expression", "depth"),
    [("rtk/a/eph/*", 2), ("rtk/*/status", 1), ("rtk/a/ref", 1), ("rtk/a/event/*", 100), ("rtk/a/obs", 1), ("rtk/**", 100), ("rtk/a/*", 2)],
)
def test_history_is_asked_for_to_the_depth_of_what_is_reached(expression: str, depth: int):
    """Zenoh holds back as many live messages as history was asked for: none means that history comes too late."""
    assert history_depth(expression) == depth


def test_a_closed_subscription_is_silent(make: Make):
    """What was taken back does not call any more; taking it back twice is once."""
    sender, receiver = make("a"), make("b")
    first, second = Inbox(), attach(receiver, sender, "rtk/a/obs")
    handle = receiver.subscribe("rtk/a/obs", first.put)
    handle.close()
    handle.close()
    sender.publish(OBS, b"x")
    assert second.get(5.0).payload == b"x"
    assert first.get(0.0) is None


def test_too_large_messages_are_counted_not_sent(make: Make):
    """The hub would drop them silently: the sender knows."""
    sender, receiver = make("a"), make("b")
    inbox = attach(receiver, sender, "rtk/a/obs")
    sender.publish(OBS, b"x" * 65_537)
    sender.publish(OBS, b"x" * 60_000)
    assert len(inbox.get(5.0).payload) == 60_000
    assert (sender.counters["too_large"], sender.counters["published"]) == (1, 1)


def test_a_failing_callback_is_counted_and_the_next_message_comes(make: Make):
    """An exception in a callback ends neither the bus nor the subscription."""
    sender, receiver = make("a"), make("b")
    seen = Inbox()

    def fragile(sample: Sample) -> None:
        seen.put(sample)
        if sample.payload == b"bad":
            raise ValueError("no good")

    receiver.subscribe("rtk/a/obs", fragile)
    attach(receiver, sender, "rtk/a/end")
    sender.publish(OBS, b"bad")
    sender.publish(OBS, b"good")
    assert [seen.get(5.0).payload, seen.get(5.0).payload] == [b"bad", b"good"]
    assert receiver.counters["callback_errors"] == 1


def ask(bus: Bus, selector: str, **options: Any) -> list[Answer]:
    """Ask until somebody answers: a queryable needs a moment to be known."""
    for _ in range(100):
        if answers := bus.get(selector, timeout_s=2.0, **options):
            return answers
        threading.Event().wait(0.02)
    return []


def test_questions_carry_payload_and_parameters_and_answers_their_key(make: Make):
    """Answers come from each queryable that matches, on its own key, errors as errors."""
    asker, one, two = make("x"), make("a"), make("b")
    queries: list[Query] = []

    def good(query: Query) -> None:
        queries.append(query)
        query.reply(b"yes", "text/plain")

    one.queryable(CMD.key("a"), good)
    two.queryable(CMD.key("b"), lambda query: query.reply_error(b"no", "application/json"))
    assert ask(asker, CMD.key("b")) == [Answer(False, "", b"no", "application/json")]
    [answer] = ask(asker, CMD.key("a") + "?op=stop;n=1", payload=b"p", encoding=encoding_of(Request))
    assert answer == Answer(True, "rtk/a/cmd", b"yes", "text/plain")
    assert (queries[-1].payload, queries[-1].encoding, queries[-1].parameters) == (b"p", encoding_of(Request), "op=stop;n=1")
    assert sorted(answer.payload for answer in ask(asker, "rtk/*/cmd")) == [b"no", b"yes"]
    assert asker.get(CMD.key("c"), timeout_s=1.0) == []


def test_a_question_can_be_answered_later_by_another_thread(make: Make):
    """The callback hands over; the work loop answers."""
    asker, answerer = make("x"), make("a")
    inbox = Inbox()
    answerer.queryable(CMD.key("a"), inbox.put)
    stop = threading.Event()

    def work() -> None:
        while not stop.is_set():
            query = inbox.get(0.02)
            if query is not None:
                query.reply(b"late", "text/plain")

    if isinstance(asker, MemoryBus):
        asker.network.on_wait = lambda: stop.wait(0.001) and None
    loop = threading.Thread(target=work)
    loop.start()
    try:
        assert [answer.payload for answer in ask(asker, CMD.key("a"))] == [b"late"]
    finally:
        stop.set()
        loop.join()


def test_an_unanswered_question_times_out_by_name(make: Make):
    """A process that is there and says nothing is told from one that is not there."""
    asker, silent = make("x"), make("a")
    kept: list[Query] = []
    silent.queryable(CMD.key("a"), kept.append)
    for _ in range(100):
        answers = asker.get(CMD.key("a"), timeout_s=0.2)
        if answers:
            break
    assert [(answer.ok, answer.timed_out) for answer in answers] == [(False, True)]


def _forget(query: Query) -> None:
    assert not query.answered


def test_a_dropped_question_is_answered_with_an_error(make: Make):
    """A handler that forgets the query does not leave the asker without an answer."""
    asker, forgetful = make("x"), make("a")
    forgetful.queryable(CMD.key("a"), _forget)
    [answer] = ask(asker, CMD.key("a"))
    assert (answer.ok, answer.timed_out) == (False, False)
    assert b"dropped" in answer.payload


def test_liveliness(make: Make):
    """Tokens are seen, by a question and by watching, until they are taken back."""
    watcher, one, two = make("x"), make("a"), make("b")
    first = one.live_token("solver", "a")
    changes = Inbox()
    watcher.on_live(changes.put)
    assert changes.get(5.0) == Liveliness("solver", "a", alive=True)
    two.live_token("ingest", "b")
    assert changes.get(5.0) == Liveliness("ingest", "b", alive=True)
    assert any(watcher.live(5.0) == {"a": "solver", "b": "ingest"} or threading.Event().wait(0.05) for _ in range(40))
    first.close()
    assert changes.get(5.0) == Liveliness("solver", "a", alive=False)
    two.close()
    assert changes.get(5.0) == Liveliness("ingest", "b", alive=False)


def test_matched_tells_whether_somebody_listens(make: Make):
    """Costly encodings are made only for listeners."""
    sender, receiver = make("a"), make("b")
    inbox = attach(receiver, sender, "rtk/*/sol/llh")
    assert any(sender.matched(SOL_TEXT, format="llh") or threading.Event().wait(0.02) for _ in range(100))
    sender.publish(SOL_TEXT, "x", format="llh")
    assert inbox.get(5.0) is not None
    assert not sender.matched(SOL_TEXT, format="xyz")


def test_a_wrong_expression_is_a_fault_of_the_caller(zenoh_hub: tuple[Bus, str]):
    """Zenoh's refusal comes as our exception."""
    with open_bus("x", [zenoh_hub[1]], timeout_s=5.0) as bus, pytest.raises(BusError):
        bus.get("rtk//x", timeout_s=0.1)


CHUNKS = st.sampled_from(["rtk", "a", "b", "@live", "obs"])


@given(st.lists(st.one_of(CHUNKS, st.sampled_from(["*", "**"])), min_size=1, max_size=5), st.lists(CHUNKS, min_size=1, max_size=5))
def test_the_twin_matches_keys_as_zenoh_does(expression: list[str], key: list[str]):
    """Wildcards mean the same in memory and on the network."""
    canonical = str(zenoh.KeyExpr.autocanonize("/".join(expression)))
    concrete = "/".join(key)
    assert matches(canonical, concrete) == zenoh.KeyExpr(canonical).intersects(zenoh.KeyExpr(concrete))


def test_processes_connect_to_the_hub_of_their_host():
    """Without ``connect`` it is the hub's own address; all interfaces are reached by loopback."""
    assert endpoints_for((), ("tcp/0.0.0.0:7547",)) == ("tcp/127.0.0.1:7547",)
    assert endpoints_for((), ("tcp/[::]:7547",)) == ("tcp/[::1]:7547",)
    assert endpoints_for(("tls/hub:1",), ("tcp/127.0.0.1:7547",)) == ("tls/hub:1",)
