"""Rules: what their words mean, when they begin and end, and what they do to processes on a bus."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtkmesh_schemas.command import Code, Reply, request_of
from rtkmesh_schemas.config import Deployment
from rtkmesh_schemas.config_rules import RuleTable
from rtkmesh_schemas.errors import ConfigError
from rtkmesh_schemas.keys import CMD, EVENT, Role
from rtkmesh_schemas.status import Event
from rtkmesh_schemas.wire import decode, encode, encoding_of
from rtkmesh_services.control.automation import Automation
from rtkmesh_services.control.rules import Change, RuleState
from rtkmesh_services.runtime.bus import Query, Sample
from rtkmesh_services.runtime.clock import ManualClock
from rtkmesh_services.runtime.configuration import parse_deployment
from rtkmesh_services.runtime.inbox import Inbox
from rtkmesh_services.runtime.memory_bus import MemoryBus, MemoryNetwork, matches
from rtkmesh_services.runtime.rule_words import RuleError, message_of, parse_rule
from rtkmesh_services.runtime.service import Context

STOP = ("stop auv_*",)


def rule(when: str, **more: object) -> RuleState:
    """Return a rule on the key ``k``, at time 0."""
    fields = {"key": "k", "do": STOP, **more}
    return RuleState(parse_rule("r", RuleTable(when=when, **fields)), 0.0)  # type: ignore[arg-type]  drawn fields


def changes(state: RuleState, values: list[tuple[float, object]]) -> list[tuple[float, bool]]:
    """Return when a rule began (True) and ended, given (time, value)."""
    found = [(now_s, state.take("k", {"v": value}, now_s)) for now_s, value in values]
    return [(now_s, change.begun) for now_s, change in found if change is not None]


def test_a_limit_has_hysteresis():
    """It begins beyond the limit and ends only beyond the limit less its hysteresis."""
    samples = [(0.0, 0.4), (1.0, 0.6), (2.0, 0.45), (3.0, 0.31), (4.0, 0.29), (5.0, 0.45), (6.0, 0.51)]
    assert changes(rule("v > 0.5", hysteresis=0.2), list(samples)) == [(1.0, True), (4.0, False), (6.0, True)]
    below = [(now_s, -value) for now_s, value in samples]
    assert changes(rule("v < -0.5", hysteresis=0.2), list(below)) == [(1.0, True), (4.0, False), (6.0, True)]


def test_a_delay_is_the_time_that_it_must_hold_without_a_break():
    """A break begins the wait anew, for the beginning and for the end."""
    state = rule("v > 0.5", delay_s=1.0, end_delay_s=2.0)
    samples = [(0.0, 1), (0.9, 1), (0.95, 0), (1.0, 1), (1.9, 1), (2.0, 1)]
    samples += [(3.0, 0), (4.9, 0), (4.95, 1), (5.0, 0), (6.9, 0), (7.1, 0)]
    assert changes(state, [*samples]) == [(2.0, True), (7.1, False)]


def test_time_alone_ends_a_delay():
    """A value that is said once and holds begins the rule when its delay is over."""
    state = rule("v > 0.5", delay_s=1.0)
    assert state.take("k", {"v": 1.0}, 0.0) is None
    assert state.tick(0.9) == []
    assert [change.begun for change in state.tick(1.0)] == [True]
    assert state.tick(9.0) == []


def test_silence_begins_after_its_delay_and_ends_with_a_message():
    """Also where nothing was ever heard; the end waits for its own delay."""
    state = rule("silent", delay_s=5.0)
    assert state.tick(4.9) == []
    assert [change.begun for change in state.tick(5.0)] == [True]
    assert state.take("k", "anything", 6.0) == Change(state.rule, "k", begun=False, value=None)
    assert state.tick(10.9) == []
    assert [change.begun for change in state.tick(11.0)] == [True]


@pytest.mark.parametrize(
    ("when", "message", "expected"),
    [
        ("state == STALE", {"state": "STALE"}, True),
        ("state != 'STALE'", {"state": "RUNNING"}, True),
        ("a.b.1 >= 2", {"a": {"b": [0, 2]}}, True),
        ("on = true", {"on": True}, True),
        ("on == true", {"on": 1}, None),
        ("value > 3", 4.0, True),
        ("value == surface", "surface", True),
        ("v > 3", {"v": float("nan")}, None),
        ("v > 3", {"v": "4"}, None),
        ("v > 3", {}, None),
        ("v > 3", [4], None),
        ("a.b > 3", {"a": 4}, None),
    ],
)
def test_what_a_condition_says_of_a_message(when: str, message: object, expected: bool | None):
    """A field that is not there or of another kind says nothing."""
    condition = parse_rule("r", RuleTable(key="k", when=when, do=STOP)).condition
    assert condition.holds(condition.of(message), begun=False) is expected


def test_messages_are_json_msgpack_or_text():
    """By encoding where it says so, else by content."""
    assert message_of(b'{"depth_m": 1.5}', "") == {"depth_m": 1.5}
    assert message_of(b"[1]", "text/plain") == [1]
    assert message_of(msgspec.msgpack.encode({"a": 1}), "application/msgpack;rtkmesh.X/1") == {"a": 1}
    assert message_of(msgspec.msgpack.encode({"a": 1.5, "b": "\xff"}), "zenoh/bytes") == {"a": 1.5, "b": "\xff"}
    assert message_of(b" 0.75\n", "") == 0.75
    assert message_of(b"surface", "") == "surface"
    with pytest.raises(ValueError, match="MessagePack"):
        message_of(b"\xc1\xff", "")


@given(
    st.lists(st.tuples(st.floats(0.0, 1e4), st.floats(allow_nan=True, allow_infinity=True)), max_size=50),
    st.floats(0.0, 10.0),
    st.floats(0.0, 3.0),
)
def test_beginnings_and_ends_alternate(samples: list[tuple[float, float]], hysteresis: float, delay_s: float):
    """Whatever the values and times: no two beginnings without an end between, and the first change is a beginning."""
    state = rule("v > 1", hysteresis=hysteresis, delay_s=delay_s, end_delay_s=delay_s)
    found = [begun for _, begun in changes(state, sorted(samples, key=lambda sample: sample[0]))]
    assert found == [index % 2 == 0 for index in range(len(found))]


@given(st.binary(max_size=200), st.sampled_from(["", "application/json", "application/msgpack", "text/plain"]))
def test_no_message_breaks_a_rule(payload: bytes, encoding: str):
    """Any bytes are a message or a ValueError, and no message makes a condition raise."""
    condition = parse_rule("r", RuleTable(key="k", when="a.0.b > 1", do=STOP)).condition
    try:
        message = message_of(payload, encoding)
    except ValueError:
        return
    condition.holds(condition.of(message), begun=False)


@pytest.mark.parametrize(
    ("table", "line", "words"),
    [
        ('when = "depth > deep"', 3, "'deep' is no number"),
        ('when = "depth"', 3, "is no condition: write FIELD > NUMBER"),
        ('when = "d > 1"\ndo = ["stop"]', 4, "write OP ID"),
        ('when = "d > 1"\ndo = ["stop auv-*"]', 4, "write OP ID"),
        ('when = "d > 1"\ndo = ["event warn dived"]', 4, "did you mean 'warning'"),
        ('when = "d > 1"\ndo = ["stop a b c"]', 4, "'c' is no argument"),
        ('when = "d == 1"\nhysteresis = 1', 4, "only > >= < <= have one"),
        ('when = "silent"\nhysteresis = 1\n', 4, "silence has none"),
        ('when = "d > 1"\ndelay = 1', 4, "did you mean 'delay_s'"),
    ],
)
def test_a_faulty_rule_is_told_with_its_line(table: str, line: int, words: str):
    """File, line, table, key and what would be right."""
    text = f'[rule.dive]\nkey = "vehicle/depth"\n{table}\nat_end = ["start x"]\n'
    with pytest.raises(ConfigError) as caught:
        parse_deployment(text, "site.toml")
    first = str(caught.value).splitlines()[0]
    assert first.startswith(f"site.toml:{line}: ")
    assert words in first
    assert "[rule.dive]" in first


def test_keys_and_silence_of_patterns_are_checked():
    """A key with an empty part, or silence of many keys, cannot be meant."""
    for key, when, field_ in (("a//b", "v > 1", "key"), ("a/$*", "v > 1", "key"), ("a/*", "silent", "when")):
        with pytest.raises(RuleError) as caught:
            parse_rule("r", RuleTable(key=key, when=when, do=STOP))
        assert caught.value.field == field_


@dataclass
class Answering:
    """A network of solvers that remember what they were told, and control's rules on it."""

    folder: Path
    network: MemoryNetwork = field(default_factory=lambda: MemoryNetwork(ManualClock()))
    told: list[tuple[str, str, str]] = field(default_factory=list[tuple[str, str, str]])
    code: Code = Code.OK

    def solver(self, id_: str) -> None:
        """Begin to be there."""
        bus = MemoryBus(id_, self.network)
        bus.queryable(CMD.key(id_), self._answer)
        bus.live_token(Role.SOLVER, id_)

    def automation(self, **tables: RuleTable) -> Automation:
        """Return rules at work."""
        bus = MemoryBus("control", self.network)
        context = Context(role=Role.CONTROL, id="control", bus=bus, deployment=Deployment(), inbox=Inbox(), clock=self.network.clock)
        made = Automation(context, self.folder)
        made.apply([parse_rule(name, table) for name, table in tables.items()], 0.0)
        self.automations.append(made)
        return made

    automations: list[Automation] = field(default_factory=list[Automation])

    def say(self, automation: Automation, depth_m: float, now_s: float) -> None:
        """Let the vehicle say its depth, and the loop take what has come."""
        self.foreign(json.dumps({"depth_m": depth_m}).encode())
        self.run(automation, now_s)

    def foreign(self, payload: bytes) -> None:
        """Let a program that is none of ours publish on a key of its own."""
        sample = Sample("vehicle/depth", payload, "", b"", 0)
        for expression, callback in self.network.subscribers:
            if matches(expression, sample.key):
                callback(sample)

    def run(self, automation: Automation, now_s: float) -> None:
        """Take what is in the inbox, then wait until all commands are given."""
        while (item := automation.context.inbox.get(0.0)) is not None:
            automation.take(item, now_s)
        automation.tick(now_s)
        automation.given()

    def events(self, code: str) -> list[Event]:
        """Return what was told."""
        samples = [sample for sample in self.network.sent if sample.key.startswith(EVENT.key("control", level="").rstrip("/"))]
        return [event for event in (decode(Event, sample.payload, sample.encoding) for sample in samples) if event.code == code]

    def _answer(self, query: Query) -> None:
        request = request_of(query.payload, query.encoding, query.parameters)
        id_ = query.key.split("/")[1]
        self.told.append((id_, request.op, request.caller))
        reply = Reply(ok=self.code in {Code.OK, Code.ACCEPTED}, code=self.code, id=id_, request_id=request.request_id)
        query.reply(encode(reply), encoding_of(Reply))


DIVE = RuleTable(key="vehicle/depth", when="depth_m > 0.5", do=("stop auv_*",), at_end=("start auv_*",))


@pytest.fixture
def network(tmp_path: Path) -> Iterator[Answering]:
    made = Answering(tmp_path)
    yield made
    for automation in made.automations:
        automation.close()


def test_a_pattern_means_those_that_are_alive_and_match(network: Answering):
    """Begin and end give their commands once each, as the rule."""
    for id_ in ("auv_a", "auv_b", "boat"):
        network.solver(id_)
    rules = network.automation(dive=DIVE)
    for now_s, depth_m in enumerate((0.0, 0.7, 0.8, 0.1, 0.0)):
        network.say(rules, depth_m, float(now_s))
    assert network.told == [(id_, op, "rule dive") for op in ("stop", "start") for id_ in ("auv_a", "auv_b")]
    assert [len(network.events(code)) for code in ("rule_begun", "rule_acted", "rule_ended", "rule_failed")] == [1, 4, 1, 0]
    assert rules.report()["dive"]["changes"] == 2


def test_who_comes_while_a_rule_holds_is_told_too(network: Answering):
    """A solver that died under water and was started again is stopped again; at the surface it is not."""
    rules = network.automation(dive=DIVE)
    network.say(rules, 1.0, 0.0)
    network.solver("auv_late")
    network.run(rules, 1.0)
    assert network.told == [("auv_late", "stop", "rule dive")]
    network.say(rules, 0.0, 2.0)
    network.solver("auv_later")
    network.run(rules, 3.0)
    assert network.told[1:] == [("auv_late", "start", "rule dive")]


def test_what_has_begun_is_remembered_over_a_restart_of_control(network: Answering):
    """The end that comes after the restart gives its commands."""
    network.solver("auv_a")
    first = network.automation(dive=DIVE)
    network.say(first, 1.0, 0.0)
    first.close()
    second = network.automation(dive=DIVE)
    network.run(second, 10.0)
    assert network.told == [("auv_a", "stop", "rule dive")] * 2, "told again: it may have been missed"
    network.say(second, 0.0, 11.0)
    assert network.told[2:] == [("auv_a", "start", "rule dive")]


def test_refusals_and_unreadable_messages_are_told(network: Answering):
    """Both are events and stand in the report; a state that is as wanted already is none."""
    network.solver("auv_a")
    rules = network.automation(dive=DIVE)
    network.code = Code.WRONG_STATE
    network.say(rules, 1.0, 0.0)
    assert network.events("rule_failed") == []
    network.code = Code.FAILED
    network.say(rules, 0.0, 1.0)
    assert [event.data["rule"] for event in network.events("rule_failed")] == ["dive"]
    network.foreign(b"\xc1\xff")
    network.run(rules, 2.0)
    assert len(network.events("rule_unread")) == 1
    assert rules.report()["dive"]["errors"] == 2


def test_rules_that_have_not_changed_go_on_at_a_reload(network: Answering):
    """Only what changed begins anew; what was taken out is silent."""
    network.solver("auv_a")
    rules = network.automation(dive=DIVE, other=msgspec.structs.replace(DIVE, do=("restart auv_a",)))
    network.say(rules, 1.0, 0.0)
    rules.apply([parse_rule("dive", DIVE)], 1.0)
    assert rules.report()["dive"]["begun"] == ["vehicle/depth"]
    network.say(rules, 0.0, 2.0)
    assert network.told == [("auv_a", "stop", "rule dive"), ("auv_a", "restart", "rule other"), ("auv_a", "start", "rule dive")]
