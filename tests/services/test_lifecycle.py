"""The life of a service, step by step, on a bus in memory with a clock that stands still."""

import json
import logging
from typing import Any, ClassVar

import msgspec
import pytest

from rtkmesh_schemas.command import Code, Reply, Request
from rtkmesh_schemas.config import Deployment, IngestTable
from rtkmesh_schemas.keys import CMD, EVENT, LATEST, METRICS, SAT, STATUS, Role
from rtkmesh_schemas.solution import SatellitesMessage
from rtkmesh_schemas.status import Event, InputStatus, Level, Metrics, ServiceStatus, State
from rtkmesh_schemas.wire import MAXIMUM_COMMAND_BYTES, decode, encode, encode_json, encoding_of
from rtkmesh_services.errors import CommandError
from rtkmesh_services.runtime.bus import Answer, Sample
from rtkmesh_services.runtime.clock import ManualClock
from rtkmesh_services.runtime.lifecycle import Lifecycle
from rtkmesh_services.runtime.memory_bus import MemoryBus, MemoryNetwork
from rtkmesh_services.runtime.service import Context, Report, Service, accepted, done
from rtkmesh_services.runtime.statistics import RollingQuantiles


class Scripted(Service):
    """A service that notes what is done with it."""

    role: ClassVar[Role] = Role.SOLVER
    operations: ClassVar[dict[str, str]] = {"count": "count up", "fail": "raise", "refuse": "say no", "work": "take long"}

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.calls: list[str] = []
        self.items: list[Any] = []
        self.counted = 0
        self.now = Report()
        self.warm_error: Exception | None = None
        self.latency = RollingQuantiles()

    def warm(self) -> None:
        self.calls.append("warm")
        if self.warm_error is not None:
            raise self.warm_error

    def open(self) -> None:
        self.calls.append("open")
        self.context.subscribe("rtk/rover/obs", lane="rover")
        self.context.subscribe("rtk/*/status", lane="status", latest=True)

    def handle(self, item: Any) -> None:
        self.items.append(item)

    def command(self, request: Request) -> Reply:
        if request.op == "fail":
            raise RuntimeError("a bug")
        if request.op == "refuse":
            raise CommandError(Code.BAD_ARGUMENTS, "not that")
        if request.op == "work":
            return accepted("working")
        self.counted += 1
        return done("counted", count=self.counted)

    def report(self) -> Report:
        return self.now

    def close(self) -> None:
        self.calls.append("close")


class World:
    """A service under test, its network, and somebody who asks."""

    def __init__(self) -> None:
        self.clock = ManualClock()
        self.network = MemoryNetwork(self.clock)
        self.bus, self.asker = MemoryBus("rtk1", self.network), MemoryBus("asker", self.network)
        deployment = Deployment(ingest={"rover": IngestTable(source="ntrip://u:secret@h/M")})
        self.context = Context(id="rtk1", role=Role.SOLVER, deployment=deployment, bus=self.bus, clock=self.clock, config_hash="abc")
        self.service = Scripted(self.context)
        self.life = Lifecycle(self.service, warm_in_thread=False)
        self.network.on_wait = lambda: self.life.step(0.0)

    def run(self) -> "World":
        self.life.start()
        self.life.step(0.0)
        return self

    def ask(self, payload: bytes = b"", encoding: str = "", parameters: str = "") -> Answer:
        selector = CMD.key("rtk1") + (f"?{parameters}" if parameters else "")
        [answer] = self.asker.get(selector, payload=payload, encoding=encoding, timeout_s=1.0)
        return answer

    def reply(self, request: Request) -> Reply:
        answer = self.ask(encode(request), encoding_of(Request))
        return decode(Reply, answer.payload, answer.encoding)

    def statuses(self) -> list[ServiceStatus]:
        return [decode(ServiceStatus, sample.payload, sample.encoding) for sample in self.bus.sent(STATUS)]


@pytest.fixture
def world() -> World:
    return World()


def test_from_start_to_end(world: World):
    """WARMING, then alive and RUNNING, then STOPPED with the reason; hooks in order."""
    world.life.start()
    assert world.asker.live() == {}
    world.life.step(0.0)
    assert world.asker.live() == {"rtk1": "solver"}
    world.life.end("SIGTERM")
    assert world.life.ended
    world.life.finish()
    assert [(status.state, status.reason) for status in world.statuses()] == [
        (State.WARMING, ""),
        (State.RUNNING, ""),
        (State.STOPPED, "SIGTERM"),
    ]
    assert world.service.calls == ["warm", "open", "close"]
    assert world.asker.live() == {}
    assert [status.heartbeat for status in world.statuses()] == [1, 2, 3]


def test_an_error_while_warming_comes_out_of_the_loop(world: World):
    """The process that cannot warm ends as FAILED, with the reason in its last status, and never was alive."""
    world.service.warm_error = ImportError("no engine")
    world.life.start()
    with pytest.raises(ImportError) as caught:
        world.life.step(0.0)
    world.life.finish(error=caught.value)
    assert world.statuses()[-1].state is State.FAILED
    assert "no engine" in world.statuses()[-1].reason
    assert world.service.calls == ["warm"]


def test_status_comes_from_the_loop_at_one_hertz(world: World):
    """No step, no heartbeat: a hung loop shows, whatever Zenoh's threads do."""
    world.run()
    count = len(world.statuses())
    world.clock.advance(10.0)
    assert len(world.statuses()) == count
    for _ in range(21):
        world.clock.advance(0.1)
        world.life.step(0.0)
    assert len(world.statuses()) == count + 3


def test_status_comes_at_once_on_a_change(world: World):
    """A change of state or reason is published in the same tick, with an event for a state."""
    world.run()
    world.service.now = Report(
        state=State.STALE,
        reason="no base for 5 s",
        inputs=[InputStatus(name="base", state="silent", age_s=5.0)],
        counters={"epochs": 7},
        latencies={"solve": world.service.latency},
        last_epoch=(2200, 1.5),
        data={"x": 1},
    )
    world.service.latency.add(world.clock.mono_ns(), 2.0)
    world.clock.advance(0.1)
    world.life.step(0.0)
    status = world.statuses()[-1]
    assert (status.state, status.reason, status.last_epoch, status.data) == (State.STALE, "no base for 5 s", (2200, 1.5), {"x": 1})
    assert status.inputs[0].name == "base"
    assert status.counters["epochs"] == 7
    assert status.latencies_ms["solve"].p50 == 2.0
    [sample] = world.bus.sent(EVENT, level="warning")
    event = decode(Event, sample.payload, sample.encoding)
    assert (event.code, event.level) == ("state_stale", Level.WARNING)


def test_items_come_by_lane_and_latest_wins(world: World):
    """Subscribed messages reach ``handle``; of states only the newest of each key."""
    world.run()
    other = MemoryBus("rover", world.network)
    for number in range(3):
        other.publish(STATUS, ServiceStatus(id="rover", role="ingest", state=State.RUNNING, start_id="s", heartbeat=number))
    for _ in range(3):
        world.life.step(0.0)
    received = [decode(ServiceStatus, item.payload) for item in world.service.items if isinstance(item, Sample)]
    assert [status.heartbeat for status in received if status.id == "rover"] == [2]


@pytest.mark.parametrize(
    ("payload", "encoding", "parameters", "answered"),
    [
        (encode(Request(op="status")), encoding_of(Request), "", "application/msgpack;rtkmesh.Reply/1"),
        (encode_json(Request(op="status")), "application/json", "", "application/json;rtkmesh.Reply/1"),
        (b'{"op":"status"}', "zenoh/bytes", "", "application/json;rtkmesh.Reply/1"),
        (b"", "", "op=status", "application/json;rtkmesh.Reply/1"),
        (b"status", "", "", "application/json;rtkmesh.Reply/1"),
    ],
)
def test_answers_are_in_the_asker_s_encoding(world: World, payload: bytes, encoding: str, parameters: str, answered: str):
    """msgpack in, msgpack out; JSON or typed by hand in, JSON out."""
    answer = world.run().ask(payload, encoding, parameters)
    assert (answer.ok, answer.encoding, answer.key) == (True, answered, "rtk/rtk1/cmd")
    reply = decode(Reply, answer.payload, answer.encoding)
    assert reply.ok
    assert (reply.id, reply.state) == ("rtk1", "RUNNING")
    assert msgspec.convert(reply.data, ServiceStatus).id == "rtk1"


def test_a_repeated_request_id_is_done_once(world: World):
    """A client that asks again because the answer was lost gets the first answer."""
    world.run()
    first = world.reply(Request(op="count", request_id="a"))
    again = world.reply(Request(op="count", request_id="a"))
    other = world.reply(Request(op="count", request_id="b"))
    assert (first.data, again.data, other.data) == ({"count": 1}, {"count": 1}, {"count": 2})
    assert again.request_id == "a"
    assert world.reply(Request(op="count")).data == {"count": 3}
    assert world.reply(Request(op="count")).data == {"count": 4}


def test_the_memory_of_request_ids_is_bounded(world: World):
    """Old request ids are forgotten, newer ones not."""
    world.run()
    for number in range(300):
        world.reply(Request(op="count", request_id=str(number)))
    assert world.reply(Request(op="count", request_id="299")).data == {"count": 300}
    assert world.reply(Request(op="count", request_id="0")).data == {"count": 301}


@pytest.mark.parametrize(
    ("request_", "code", "words"),
    [
        (Request(op="coutn"), Code.UNKNOWN_OP, "did you mean 'count'"),
        (Request(op="xyz"), Code.UNKNOWN_OP, "shutdown"),
        (Request(op="refuse"), Code.BAD_ARGUMENTS, "not that"),
        (Request(op="fail"), Code.FAILED, "a bug"),
        (Request(op="log", args={"level": "loud"}), Code.BAD_ARGUMENTS, "debug, info"),
    ],
)
def test_failures_are_error_replies_with_a_code(world: World, request_: Request, code: Code, words: str):
    """A command that cannot be done says why; the process lives on."""
    world.run()
    answer = world.ask(encode(request_), encoding_of(Request))
    reply = decode(Reply, answer.payload, answer.encoding)
    assert not answer.ok
    assert not reply.ok
    assert reply.code is code
    assert words in reply.message
    assert world.reply(Request(op="count")).ok


def test_a_bug_in_a_command_is_logged_with_its_traceback(world: World, caplog: pytest.LogCaptureFixture):
    """The answer is short; the log has the whole story."""
    with caplog.at_level(logging.ERROR):
        world.run().reply(Request(op="fail"))
    assert "RuntimeError: a bug" in caplog.text


def test_every_command_is_logged_with_its_caller(world: World, caplog: pytest.LogCaptureFixture):
    """Who did what stays on record."""
    with caplog.at_level(logging.INFO):
        world.run().reply(Request(op="count", caller="ann@host:5"))
    assert "command count from ann@host:5: ok" in caplog.text


@pytest.mark.parametrize(
    ("payload", "code"), [(b"x" * (MAXIMUM_COMMAND_BYTES + 1), Code.TOO_LARGE), (b"{", Code.BAD_REQUEST), (b"\xff\xfe", Code.BAD_REQUEST)]
)
def test_malformed_questions_get_a_typed_error(world: World, payload: bytes, code: Code):
    """Whatever is sent, the answer is a reply."""
    answer = world.run().ask(payload, "application/json")
    reply = json.loads(answer.payload)
    assert (answer.ok, reply["ok"], reply["code"], reply["id"]) == (False, False, code.value, "rtk1")


def test_commands_are_answered_while_warming(world: World):
    """Status and help answer at once; the role's own operations say that it is too early."""
    world.life._warm_in_thread = True
    world.service.warm = lambda: world.context.stopping.wait(30.0)  # type: ignore[method-assign]  a warm-up that takes long
    world.life.start()
    assert world.reply(Request(op="status")).state == "WARMING"
    assert world.reply(Request(op="count")).code is Code.WRONG_STATE
    assert world.reply(Request(op="help")).data["operations"]["count"] == "count up"
    world.life.end("test")


def test_shutdown_is_accepted_and_ends_the_loop(world: World):
    """The answer goes out before the end."""
    assert world.run().reply(Request(op="shutdown", caller="ann")).code is Code.ACCEPTED
    assert world.life.ended
    assert world.life.end_reason == "shutdown by ann"


def test_who_still_waits_at_the_end_is_answered(world: World):
    """No question is left without an answer by a process that ends in order."""
    world.run()
    world.network.on_wait = lambda: world.life.finish() if not world.bus.sent(STATUS)[-1].payload.count(b"STOPPED") else None
    reply = world.reply(Request(op="count"))
    assert (reply.ok, reply.code) == (False, Code.WRONG_STATE)


def test_the_configuration_is_shown_without_secrets(world: World):
    """``config`` tells the process's table, passwords masked."""
    world.run()
    ingest = Lifecycle(
        Scripted(Context(id="rover", role=Role.INGEST, deployment=world.context.deployment, bus=world.asker, clock=world.clock)),
        warm_in_thread=False,
    )
    ingest.start()
    ingest.step(0.0)
    world.network.on_wait = lambda: ingest.step(0.0)
    [answer] = world.bus.get(CMD.key("rover"), payload=b"config", timeout_s=1.0)
    reply = decode(Reply, answer.payload, answer.encoding)
    assert reply.data["table"]["source"] == "ntrip://u:***@h/M"
    assert b"secret" not in answer.payload


def test_latest_gives_the_newest_of_each_stream(world: World):
    """A plain get reads what a cache of the publisher would not give."""
    world.run()
    satellites = SatellitesMessage(
        source="rtk1",
        week=1,
        tow_s=2.0,
        satellite=["G01"],
        signal=["1C"],
        state=[1],
        azimuth_deg=[0.0],
        elevation_deg=[1.0],
        cn0_dbhz=[45.0],
        code_residual_m=[0.0],
        phase_residual_m=[0.0],
        ambiguity_cyc=[0.0],
        lock_s=[1.0],
        slips=[0],
    )
    world.bus.publish(SAT, satellites)
    [all_] = world.asker.get(LATEST.key("rtk1"), timeout_s=1.0)
    assert set(json.loads(all_.payload)) == {"sat", "status"}
    assert json.loads(all_.payload)["status"]["id"] == "rtk1"
    [one] = world.asker.get(LATEST.key("rtk1") + "?what=sat,sol", payload=b"\x80", encoding="application/msgpack", timeout_s=1.0)
    found = msgspec.msgpack.decode(one.payload, type=dict[str, SatellitesMessage])
    assert found == {"sat": satellites}
    [wrong] = world.asker.get(LATEST.key("rtk1") + "?what=nothing", timeout_s=1.0)
    assert (wrong.ok, json.loads(wrong.payload)["code"]) == (False, "not_found")


def test_metrics_are_flat_numbers_while_somebody_listens(world: World):
    """rtk/{id}/metrics costs nothing unread, and has counters and quantiles when read."""
    world.run()
    assert world.bus.sent(METRICS) == []
    world.asker.subscribe("rtk/*/metrics", list[Sample]().append)
    world.service.latency.add(world.clock.mono_ns(), 3.0)
    world.service.now = Report(counters={"epochs": 2}, latencies={"solve": world.service.latency})
    world.clock.advance(1.0)
    world.life.step(0.0)
    values = decode(Metrics, world.bus.sent(METRICS)[-1].payload).values
    assert values["epochs"] == 2.0
    assert values["solve_p99_ms"] == 3.0


def test_drops_of_the_inbox_are_counted_in_the_status(world: World):
    """A loop that cannot keep up says so."""
    world.context.inbox.lane("rover", capacity=2)
    world.run()
    for _ in range(5):
        world.context.inbox.put("item", lane="rover")
    world.clock.advance(1.0)
    world.life.step(0.0)
    assert world.statuses()[-1].counters["dropped_rover"] == 3


def test_too_many_waiting_commands_are_answered_busy(world: World):
    """A flood of questions is bounded and every one is answered."""
    world.run()
    world.network.on_wait = None
    for _ in range(65):
        world.asker.get(CMD.key("rtk1"), payload=b"count", timeout_s=0.0)
    assert world.context.inbox.depth("command") == 64
    assert world.context.inbox.dropped() == {"command": 1}
