"""The desk of commands: what is done once, what is refused, what is on record; whatever comes in, a reply goes out."""

import json
from typing import Any, ClassVar

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtkmesh_schemas.command import Code, Reply, Request
from rtkmesh_schemas.command_limits import MAXIMUM_DEPTH, MAXIMUM_VALUES, fault_of
from rtkmesh_schemas.config import Deployment
from rtkmesh_schemas.keys import CMD, EVENT, Role
from rtkmesh_schemas.status import Event
from rtkmesh_schemas.wire import MAXIMUM_COMMAND_BYTES, decode, encode, encoding_of
from rtkmesh_services.runtime.answers import MAXIMUM_ANSWER_BYTES, Answers
from rtkmesh_services.runtime.audit import shown
from rtkmesh_services.runtime.bus import Answer
from rtkmesh_services.runtime.calls import call
from rtkmesh_services.runtime.clock import ManualClock
from rtkmesh_services.runtime.lifecycle import Lifecycle
from rtkmesh_services.runtime.memory_bus import MemoryBus, MemoryNetwork
from rtkmesh_services.runtime.service import Context, Service, done

NOW_NS = ManualClock().utc_ns()
SECOND = 1_000_000_000


class Counter(Service):
    """Counts what is really done."""

    role: ClassVar[Role] = Role.SOLVER
    operations: ClassVar[dict[str, str]] = {"survey_in": "count up", "look": "read"}
    reads: ClassVar[frozenset[str]] = frozenset({"look"})

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.counted = 0

    def handle(self, item: Any) -> None:
        raise AssertionError(f"nothing is subscribed, and {item} came")

    def command(self, request: Request) -> Reply:
        self.counted += request.op == "survey_in"
        return done("counted", count=self.counted, filling="x" * int(request.args.get("size", 0)))


class World:
    """A service with its desk, and somebody who asks."""

    def __init__(self) -> None:
        self.network = MemoryNetwork(ManualClock())
        self.bus, self.asker = MemoryBus("rtk", self.network), MemoryBus("asker", self.network)
        self.context = Context(id="rtk", role=Role.SOLVER, deployment=Deployment(), bus=self.bus, clock=self.network.clock)
        self.service = Counter(self.context)
        self.life = Lifecycle(self.service, warm_in_thread=False)
        self.network.on_wait = lambda: self.life.step(0.0)
        self.life.start()
        self.life.step(0.0)

    def answer(self, payload: bytes, encoding: str = "", parameters: str = "") -> Answer:
        [answer] = self.asker.get(f"{CMD.key('rtk')}?{parameters}", payload=payload, encoding=encoding, timeout_s=1.0)
        return answer

    def ask(self, **fields: Any) -> Reply:
        answer = self.answer(encode(Request(**{"op": "survey_in", **fields})), encoding_of(Request))
        reply = decode(Reply, answer.payload, answer.encoding)
        assert answer.ok == reply.ok
        return reply

    def events(self) -> list[Event]:
        samples = [sample for level in ("info", "warning") for sample in self.bus.sent(EVENT, level=level)]
        events = [decode(Event, sample.payload, sample.encoding) for sample in samples]
        return sorted((event for event in events if event.code == "command"), key=lambda event: event.sequence)


@pytest.fixture
def world() -> World:
    return World()


def test_a_request_id_of_another_command_is_refused(world: World):
    """Nobody gets another's answer, and nothing is done; the same command gets its own again, word for word."""
    first = world.ask(request_id="7", args={"a": 1, "b": 2}, caller="ann")
    assert world.ask(request_id="7", args={"b": 2, "a": 1}, caller="ann") == first
    for other in ({"op": "look"}, {"args": {"a": 2}}, {"args": {"a": 1, "b": 2}, "caller": "bob"}):
        reply = world.ask(**{"request_id": "7", "args": {"a": 1, "b": 2}, "caller": "ann", **other})
        assert (reply.code, reply.request_id, reply.id) == (Code.CONFLICT, "7", "rtk")
    assert world.service.counted == 1


@pytest.mark.parametrize(
    ("fields", "code"),
    [
        ({"expires_utc_ns": NOW_NS - 1}, Code.STALE),
        ({"expires_utc_ns": NOW_NS + SECOND}, Code.OK),
        ({"issued_utc_ns": NOW_NS - 11 * SECOND}, Code.STALE),
        ({"issued_utc_ns": NOW_NS + 11 * SECOND}, Code.STALE),
        ({"issued_utc_ns": NOW_NS - 9 * SECOND}, Code.OK),
        ({"start_id": "another"}, Code.STALE),
    ],
)
def test_what_comes_too_late_is_not_done(world: World, fields: dict[str, Any], code: Code):
    """Expired, issued long ago or in the future, or meant for another run of the process."""
    reply = world.ask(**fields)
    assert (reply.code, world.service.counted) == (code, int(code is Code.OK))


def test_a_command_for_this_run_is_done(world: World):
    """Who read the start id from a status commands this run and no later one."""
    assert world.ask(start_id=world.context.start_id).ok


def test_an_expired_duplicate_still_gets_its_answer(world: World):
    """A repeated question whose first one was in time was done: it is told so, not that it is too late."""
    first = world.ask(request_id="1", expires_utc_ns=NOW_NS + SECOND)
    world.network.clock.advance(2.0)  # type: ignore[attr-defined]  a ManualClock
    assert world.ask(request_id="1", expires_utc_ns=NOW_NS + SECOND) == first


def test_times_may_be_parameters(world: World):
    """The form that is typed into a selector says the same."""
    stale = json.loads(world.answer(b"", parameters=f"op=survey_in&expires_utc_ns={NOW_NS - 5}").payload)
    wrong = json.loads(world.answer(b"", parameters="op=survey_in&expires_utc_ns=soon").payload)
    assert (stale["code"], wrong["code"], world.service.counted) == ("stale", "bad_request", 0)


@pytest.mark.parametrize("op", ["survey_in", "survey-in", "Survey-In", " SURVEY_IN "])
def test_the_form_of_a_name_does_not_matter(world: World, op: str):
    """Hyphens, capitals and blanks."""
    assert world.ask(op=op).data["count"] == 1


def nested(depth: int) -> Any:
    return "core" if depth == 0 else [nested(depth - 1)]


@pytest.mark.parametrize(
    "args",
    [
        {"a": nested(MAXIMUM_DEPTH)},
        {"a": [0] * MAXIMUM_VALUES},
        {"a": float("nan")},
        {"a": [{"b": float("inf")}]},
        {"a": b"bytes"},
        {"a": msgspec.msgpack.Ext(1, b"x")},
        {"a": {1: 2}},
        {"n" * 65: 1},
        {"": 1},
        {"a\n": 1},
        {"a": 1 << 63},
    ],
)
def test_arguments_are_plain_and_bounded(world: World, args: dict[str, Any]):
    """Depth, number, names, and what msgpack knows beyond JSON: refused, with the asker's id in the answer."""
    reply = world.ask(args=args, request_id="9")
    assert (reply.code, reply.request_id, world.service.counted) == (Code.BAD_REQUEST, "9", 0)


def test_numbers_of_any_length_in_json_are_refused(world: World):
    """JSON has no largest number."""
    answer = world.answer(b'{"op":"survey_in","args":{"a":' + b"9" * 4000 + b"}}")
    assert json.loads(answer.payload)["code"] == "bad_request"
    assert world.service.counted == 0


def test_what_is_within_the_limits_is_done(world: World):
    """The limits are not tighter than they say."""
    args = {"a": nested(MAXIMUM_DEPTH - 1), "n" * 64: [0] * (MAXIMUM_VALUES - MAXIMUM_DEPTH - 4), "big": (1 << 63) - 1, "none": None}
    assert fault_of(Request(op="x", args=args)) == ""
    assert world.ask(args=args).ok


@pytest.mark.parametrize("fields", [{"op": " "}, {"op": "x" * 65}, {"request_id": "x" * 257}, {"caller": "x" * 257}])
def test_labels_are_bounded(world: World, fields: dict[str, Any]):
    """What is kept and written down has a largest size."""
    assert world.ask(**fields).code is Code.BAD_REQUEST


def test_the_memory_of_answers_is_bounded_in_bytes():
    """Large answers push out old ones; one that is too large is not kept and pushes nothing out."""
    answers = Answers(maximum_bytes=10_000)
    for number in range(20):
        answers.keep(Request(op="x", request_id=str(number)), done("y" * 1000))
    assert 8 <= len(answers) <= 10
    assert answers.bytes <= 10_000
    assert answers.find(Request(op="x", request_id="19")) is not None
    assert answers.find(Request(op="x", request_id="0")) is None
    count = len(answers)
    answers.keep(Request(op="x", request_id="large"), done("y" * 10_001))
    assert (answers.find(Request(op="x", request_id="large")), len(answers)) == (None, count)
    for number in range(20):
        answers.keep(Request(op="x", request_id=f"s{number}"), done())
    assert answers.bytes < 10_000
    assert MAXIMUM_ANSWER_BYTES <= 1 << 20


def test_every_command_is_an_event_with_its_caller(world: World):
    """Done, refused and unreadable ones; reads are none, a repeated one is one."""
    world.ask(caller="ann", request_id="1", args={"mode": "fast"})
    world.ask(caller="ann", request_id="1", args={"mode": "fast"})
    world.ask(op="survy_in", caller="bob")
    world.ask(op="look")
    for op in ("status", "help", "config", "metrics"):
        world.ask(op=op)
    world.answer(b"\xc1")
    world.answer(b"x" * (MAXIMUM_COMMAND_BYTES + 1))
    world.ask(args={"a": float("nan")}, caller="eve")
    seen = [(event.data["op"], event.data["caller"], event.data["result"]) for event in world.events()]
    assert seen == [
        ("survey_in", "ann", "ok"),
        ("survy_in", "bob", "unknown_op"),
        ("", "", "bad_request"),
        ("", "", "too_large"),
        ("survey_in", "eve", "bad_request"),
    ]
    assert world.events()[0].data["args"] == {"mode": "fast"}


def test_a_stale_or_conflicting_command_is_an_event(world: World):
    """Those who look for replayed commands find them."""
    world.ask(request_id="1")
    world.ask(request_id="1", args={"x": 1})
    world.ask(expires_utc_ns=1)
    assert [event.data["result"] for event in world.events()] == ["ok", "conflict", "stale"]
    assert [event.level.value for event in world.events()] == ["info", "warning", "warning"]


@pytest.mark.parametrize(
    "args",
    [
        {"password": "hunter2"},
        {"ntrip_password": "hunter2"},
        {"key": "console-passwd", "value": "hunter2"},
        {"source": "ntrip://me:hunter2@host/M"},
        {"inner": {"url": "ntrip://me:hunter2@host/M", "password": "hunter2"}},
        {"token": ["hunter2"]},
        {"text": "password=hunter2"},
    ],
)
def test_secrets_in_arguments_are_not_on_record(world: World, args: dict[str, Any]):
    """By the argument's name, by what a set sets, in a URL."""
    world.ask(args=args)
    assert "hunter2" not in str(shown(args))
    assert not any(b"hunter2" in sample.payload for sample in world.network.sent)


def test_long_arguments_are_clipped_on_record():
    """An event stays an event, whatever was asked."""
    found = shown({"a": "x" * 5000, "b": [1] * 500, **{f"n{number}": 1 for number in range(100)}})
    assert len(found) == 16
    assert all(len(str(value)) < 300 for value in found.values())


def test_call_says_until_when(world: World):
    """A helper's command that waits too long in a queue is not done any more (the clock of the test is years behind: in time)."""
    [reply] = call(world.asker, "rtk", "survey_in", expires_s=1.0)
    assert reply.ok


json_like = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=20,
)
shared_world = World()


@given(
    st.binary(max_size=400) | json_like.map(lambda value: json.dumps(value).encode()),
    st.sampled_from(
        ["", "application/json", "application/msgpack;rtkmesh.Request/1", "application/msgpack;rtkmesh.Request/2", "text/plain"]
    ),
    st.text(max_size=60),
)
def test_any_bytes_get_a_reply(payload: bytes, encoding: str, parameters: str):
    """Whatever the payload, the encoding and the parameters: one reply with a code, and the process goes on."""
    answer = shared_world.answer(payload, encoding, parameters)
    reply = decode(Reply, answer.payload, answer.encoding)
    assert (reply.ok, reply.id) == (answer.ok, "rtk")


@given(
    st.sampled_from(["survey_in", "look", "status", "help", "config", "metrics", "log", "nothing"]) | st.text(max_size=70),
    st.dictionaries(st.text(max_size=70), json_like, max_size=5),
    st.sampled_from(["", "1", "2"]),
    st.integers(min_value=-(1 << 63), max_value=(1 << 64) - 1),
    st.text(max_size=20),
)
def test_any_request_gets_a_reply_and_no_other_s(op: str, args: dict[str, Any], request_id: str, time_ns: int, caller: str):
    """Well-formed requests of any content: answered with their own id."""
    if fault_of(Request(op=op, args=args)) == "" and op.strip().lower() == "log":
        args.pop("level", None)  # the level of this test's own log stays
    body = {"op": op, "args": args, "request_id": request_id, "issued_utc_ns": time_ns, "caller": caller}
    try:
        payload = msgspec.msgpack.encode(body)
    except OverflowError:  # msgpack's numbers end at 64 bits
        payload = json.dumps(body).encode()
    answer = shared_world.answer(payload)
    reply = decode(Reply, answer.payload, answer.encoding)
    assert reply.request_id in ("", request_id)
    assert reply.ok or reply.message
