"""Asking a process, and the names of the ways in which it does not answer (in memory; the real ones are in test_processes)."""

from collections.abc import Callable

import pytest

from rtkmesh_schemas.command import Code, Reply
from rtkmesh_schemas.errors import BadKeyError
from rtkmesh_schemas.keys import CMD
from rtkmesh_schemas.wire import encode, encoding_of
from rtkmesh_services.runtime.bus import Query
from rtkmesh_services.runtime.calls import call
from rtkmesh_services.runtime.memory_bus import MemoryBus, MemoryNetwork


@pytest.fixture
def network() -> MemoryNetwork:
    return MemoryNetwork()


def serve(network: MemoryNetwork, name: str, answer: Callable[[Query], None] | None, *, live: bool = True) -> list[Query]:
    """Put a process on the network that answers so; return what it was asked."""
    bus, asked = MemoryBus(name, network), list[Query]()

    def on_query(query: Query) -> None:
        asked.append(query)
        if answer is not None:
            answer(query)

    bus.queryable(CMD.key(name), on_query)
    if live:
        bus.live_token("solver", name)
    return asked


def ok(query: Query) -> None:
    query.reply(encode(Reply(ok=True, code=Code.OK, id=query.key.split("/")[1])), encoding_of(Reply))


def no(query: Query) -> None:
    query.reply_error(encode(Reply(ok=False, code=Code.WRONG_STATE, message="not now", id="a")), encoding_of(Reply))


def ask(network: MemoryNetwork, name: str) -> list[Reply]:
    return call(MemoryBus("asker", network), name, "status", deadline_s=0.05, pause=list[float]().append)


def test_an_answer_is_given_on(network: MemoryNetwork):
    """The reply of the one who was asked."""
    asked = serve(network, "a", ok)
    [reply] = ask(network, "a")
    assert (reply.ok, reply.id) == (True, "a")
    assert len(asked) == 1


def test_an_error_reply_is_given_on(network: MemoryNetwork):
    """A process that says no is not one that is silent."""
    serve(network, "a", no)
    [reply] = ask(network, "a")
    assert (reply.ok, reply.code, reply.message) == (False, Code.WRONG_STATE, "not now")


def test_absent_with_the_nearest_name(network: MemoryNetwork):
    """Nobody of that name: who is nearest."""
    serve(network, "rover_rtk", ok)
    [reply] = ask(network, "rover_rtl")
    assert reply.code is Code.ABSENT
    assert "did you mean 'rover_rtk'" in reply.message
    [reply] = ask(network, "x")
    assert "there are rover_rtk" in reply.message


def test_absent_on_an_empty_network(network: MemoryNetwork):
    """The message still reads well."""
    [reply] = ask(network, "x")
    assert reply.message.endswith("nobody is")


def test_hung_is_there_and_says_nothing(network: MemoryNetwork):
    """A token and no answer in time."""
    asked = serve(network, "a", None)
    [reply] = ask(network, "a")
    assert (reply.code, reply.id) == (Code.HUNG, "a")
    assert len({query.payload for query in asked}) == 1  # asked again with the same request id


def test_refused_is_there_and_cannot_be_asked(network: MemoryNetwork):
    """A token, and the question comes back empty: access rules."""
    MemoryBus("a", network).live_token("solver", "a")
    [reply] = ask(network, "a")
    assert reply.code is Code.REFUSED


def test_empty_answers_are_asked_again(network: MemoryNetwork):
    """A queryable that has just reconnected is found before the deadline."""
    bus = MemoryBus("a", network)
    bus.live_token("solver", "a")
    pauses: list[float] = []

    def pause(seconds: float) -> None:
        pauses.append(seconds)
        if len(pauses) == 3:
            bus.queryable(CMD.key("a"), ok)

    [reply] = call(MemoryBus("asker", network), "a", "status", deadline_s=5.0, pause=pause)
    assert reply.ok
    assert len(pauses) == 3


def test_all_gives_one_reply_each_also_for_the_silent(network: MemoryNetwork):
    """``*``: who answers, who hangs, who refuses; nobody twice, nobody forgotten."""
    serve(network, "a", ok)
    serve(network, "b", None)
    serve(network, "c", ok, live=False)
    replies = ask(network, "*")
    assert [(reply.id, reply.ok, reply.code) for reply in replies] == [
        ("a", True, Code.OK),
        ("b", False, Code.HUNG),
        ("c", True, Code.OK),
    ]


def test_all_of_nobody_is_empty(network: MemoryNetwork):
    """An empty network has no replies."""
    assert ask(network, "*") == []


def test_a_wrong_id_is_a_fault_of_the_caller(network: MemoryNetwork):
    """No key is asked that the table does not know."""
    with pytest.raises(BadKeyError):
        ask(network, "a/b")


def test_a_dropped_question_is_answered_with_an_error(network: MemoryNetwork):
    """Whoever loses a query without answering it has answered that."""
    answered: list[tuple[bytes, bool]] = []

    class Noted(Query):
        def _send(self, payload: bytes, encoding: str, *, error: bool) -> None:
            answered.append((payload + encoding.encode(), error))

    query = Noted("rtk/a/cmd", b"", "", "")
    query.reply(b"first", "")
    query.reply(b"second", "")
    del query
    Noted("rtk/a/cmd", b"", "", "")
    assert answered[0] == (b"first", False)
    assert len(answered) == 2
    assert answered[1][1]
