"""Skybrush 2.50's recorded transcripts against our server: each request is said again, each answer compared with the recorded one.

``DIFFERENT`` is the list of all answers that differ, with what is answered here and why; numbers are those of the bugs of the recorded
server (the project's notes on the seed systems, section 1.6). Left out of every comparison: ids of messages, time stamps; ages may be off
by ``AGE_MS``.
"""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import pytest
from tests.services.flockwave_world import BASE_A, BASE_B, SkybrushClient, World

from rtkmesh_schemas.flockwave import ANSWERS, Message, request_of

LOGS = ("skybrush_tcp_1.log", "skybrush_tcp_2.log")
AGE_MS = 15
NOTHING = "(no reply in 3 s)"
# When requests were made, in seconds after the base was selected (from the recorded ages of its messages).
INSTANTS = {
    LOGS[0]: {"q15": 6.994, "q25": 7.036},
    LOGS[1]: {"q3": 3.498, "q5": 11.001, "q6": 11.503, "q7": 19.503},
}
# The recorded base was told its place after the second of these: until then ours does not answer.
HOLDS_FROM, HOLDS_TO = (LOGS[1], "q5"), (LOGS[1], "q6")
SELECTS = {LOGS[0]: ("q13", BASE_A), LOGS[1]: ("q1", BASE_B)}
ACKNOWLEDGED = {"type": "ACK-ACK"}
DEFAULTS = {"settings": {"accuracy": 1.0, "duration": 60, "messageSet": "msm7"}, "type": "RTK-SURVEY"}
GOAL = {"accuracy": 0.5, "duration": 30.0, "messageSet": "msm7"}
RTCM3_ONLY = {"type": "ACK-NAK", "reason": "a source of format rtcm3 takes no orders: base-a cannot be surveyed (auto and ubx can)"}
STREAM_PLACE = {"position": [461214594, 154376559, 253204, None], "positionECEF": [4268987000, 1178894000, 4574798000]}
IDLE = {"antenna": {}, "cnr": {}, "messages": {}, "messages_tx": {}, "survey": {"accuracy": 0.0, "flags": 0}, "type": "RTK-STAT"}
WHO = "another program"
ALL = {"base-a", "base-b"}


def _errors(kind: str, **error: str) -> dict[str, Any]:
    return {"type": kind, "result": {}, "error": {name.replace("_", "-"): text for name, text in error.items()}}


NOT_USERS = "Only user-defined presets can be deleted"
# (log, request) -> (why, what is answered here; a set: those ids and made ones; None: see the test)
DIFFERENT: dict[tuple[str, str], tuple[str, Any]] = {
    (LOGS[0], "q1"): (WHO, None),
    (LOGS[0], "q18"): ("2: acknowledged though nothing can be surveyed", RTCM3_ONLY),
    (LOGS[0], "q23"): ("2", RTCM3_ONLY),
    (LOGS[0], "q24"): ("2: what was refused has changed nothing", DEFAULTS),
    (LOGS[0], "q25"): ("2: as above; the position is that of the stream", STREAM_PLACE),
    (LOGS[0], "q27"): ("1: a change of the source ends all of RTK", DEFAULTS),
    (LOGS[0], "q28"): ("1", IDLE),
    (LOGS[0], "q30"): ("1", {"type": "X-RTK-NEW"}),
    (LOGS[0], "q31"): ("1", {"type": "ACK-NAK", "reason": "Preset must not have an ID"}),
    (LOGS[0], "q32"): ("1", ALL),
    (LOGS[0], "q33"): ("1", _errors("X-RTK-DEL", base_a=NOT_USERS, nope="No such RTK preset")),
    (LOGS[0], "q34"): ("1", _errors("X-RTK-UPDATE", base_a=NOT_USERS)),
    (LOGS[0], "q35"): ("1", ACKNOWLEDGED),
    (LOGS[0], "q36"): ("1", ACKNOWLEDGED),
    (LOGS[0], "q37"): ("1", {"type": "RTK-SOURCE", "id": None}),
    (LOGS[0], "q38"): ("1", IDLE),
    (LOGS[0], "z2"): ("1", ALL),
    (LOGS[0], "q46"): ("5: a line that is no message ends the connection", ALL),
    (LOGS[1], "q7"): (
        "4, 6: called valid unheard; the base goes on to send another place",
        {"accuracy": 0.02, "flags": 1},
    ),
    (LOGS[1], "q9"): ("3: the accuracy of a position becomes the goal of the survey", GOAL),
    (LOGS[1], "q11"): ("3", GOAL),
    (LOGS[1], "q23"): ("2", {"type": "ACK-NAK", "reason": "no RTK source is selected: nothing to survey with"}),
    (LOGS[1], "z3"): ("5: an error of a client ends the connection", "No handler managed to parse this message in the server"),
    (LOGS[1], "z4"): ("5: a message without a body ends the connection", "Flockwave message does not match schema"),
}
# Answers with ids that are made by chance.
BY_CHANCE = {(LOGS[1], "q12"), (LOGS[1], "q16"), (LOGS[1], "z2")}


@dataclass
class Pair:
    """A request as it was said, the answer, and the notifications that came before it."""

    said: str
    answer: dict[str, Any] | None = None
    notifications: list[dict[str, Any]] = field(default_factory=list)

    @property
    def id(self) -> str:
        try:
            return str(json.loads(self.said).get("id", ""))
        except ValueError:
            return ""


def pairs(path: Path) -> list[Pair]:
    """The recorded requests with what came back."""
    found: list[Pair] = []
    for line in path.read_text().splitlines():
        if line.startswith(">> "):
            found.append(Pair(line[3:]))
        elif line.startswith("<< {"):
            message = json.loads(line[3:])
            if "refs" in message:
                found[-1].answer = message
            else:
                found[-1].notifications.append(message)
    return found


def said_again(log: str, recorded: list[Pair], world: World, client: SkybrushClient) -> dict[int, dict[str, Any] | None]:
    """Say all requests, at their time; return the answers by number."""
    selects, base = SELECTS[log]
    now_s = 0.0
    answers: dict[int, dict[str, Any] | None] = {}
    for number, pair in enumerate(recorded):
        then_s = INSTANTS[log].get(pair.id)
        if then_s is not None:
            world.stream(base, now_s, then_s)
            now_s = then_s
        if (log, pair.id) == HOLDS_FROM:
            world.puppets[base].acknowledges.clear()
        answers[number] = answer_to(pair, client)
        if (log, pair.id) == HOLDS_TO:
            world.puppets[base].acknowledges.set()
        if pair.id == selects:
            world.stream(base, 0.0, 0.0)
            now_s = 1e-6
    return answers


def answer_to(pair: Pair, client: SkybrushClient) -> dict[str, Any] | None:
    """Return the answer, None where none comes before that of a later request."""
    if pair.id:
        return client.ask(json.loads(pair.said))
    before = len(client.lines)
    client.say(pair.said)
    client.silence()
    assert len(client.lines) == before + 1
    return None


def plain(body: dict[str, Any]) -> dict[str, Any]:
    """Return a body without what differs by nature: ages (checked on their own) and time stamps."""
    text = json.dumps(body)
    copy: dict[str, Any] = json.loads(text)
    for name in ("messages", "messages_tx"):
        copy[name] = {kind: row[1] for kind, row in copy[name].items()} if name in copy else None
    for status in (copy.get("status") or {}).values():
        status.pop("timestamp", None)
    return copy


def ages(body: dict[str, Any]) -> dict[str, float]:
    return {f"{name} {kind}": row[0] for name in ("messages", "messages_tx") for kind, row in body.get(name, {}).items()}


def is_expected(ours: dict[str, Any], expected: Any, theirs: dict[str, Any] | None) -> bool:
    """Whether a different answer is the one that is meant."""
    if isinstance(expected, str):
        return ours == {"type": "ACK-NAK", "reason": expected}
    if isinstance(expected, set):
        return expected < set(ours["ids"]) and len(ours["ids"]) == 3
    if "flags" in expected:
        return ours["survey"] == expected and plain({**ours, "survey": {}}) == plain({**(theirs or {}), "survey": {}})
    if "positionECEF" in expected:
        return ours["antenna"] == {**(theirs or {})["antenna"], **expected} and plain({**ours, "antenna": {}}) == plain(
            {**(theirs or {}), "antenna": {}}
        )
    if "messageSet" in expected:
        return ours == {"type": "RTK-SURVEY", "settings": expected}
    return ours == {**ours, **expected} if expected == {"type": "X-RTK-NEW"} else ours == expected


@pytest.mark.data
@pytest.mark.parametrize("log", LOGS)
def test_recorded_requests_are_answered_as_recorded(log: str, data: Path, world: World, client: SkybrushClient):
    """All pairs of a transcript, over a real TCP connection: equal, or different for a reason that is told and into what is told."""
    recorded = pairs(data / "flockwave" / log)
    answers = said_again(log, recorded, world, client)
    equal, different = [], []
    for number, pair in enumerate(recorded):
        ours, theirs, key = answers[number], pair.answer, (log, pair.id)
        ours_body, theirs_body = (None if answer is None else answer["body"] for answer in (ours, theirs))
        if ours is not None:
            assert set(ours) == {"$fw.version", "id", "refs", "body"}
            assert (ours["$fw.version"], ours["refs"]) == ("1.0", pair.id)
        if key in DIFFERENT:
            _, expected = DIFFERENT[key]
            assert ours_body is not None
            assert ours_body != theirs_body
            assert expected is None or is_expected(ours_body, expected, theirs_body), (key, ours_body, expected)
            different.append(pair.id)
        elif key in BY_CHANCE:
            assert ours_body is not None
            assert theirs_body is not None
            assert ours_body.keys() == theirs_body.keys()
            assert ours_body.get("ids", [])[:2] == theirs_body.get("ids", [])[:2]
            equal.append(pair.id)
        else:
            assert (ours_body and plain(ours_body)) == (theirs_body and plain(theirs_body)), (key, ours_body)
            for name, age_ms in ages(theirs_body or {}).items():
                assert abs(ages(ours_body or {})[name] - age_ms) <= AGE_MS, (key, name)
            equal.append(pair.id or pair.said)
    assert len(different) == len([key for key in DIFFERENT if key[0] == log])
    assert (len(equal), len(different)) == {LOGS[0]: (28, 18), LOGS[1]: (20, 6)}[log], (equal, different)


@pytest.mark.data
@pytest.mark.parametrize("log", LOGS)
def test_notifications_come_as_recorded(log: str, data: Path, world: World, client: SkybrushClient):
    """Connections and beacons are told in the recorded order, up to where the recorded server had lost its RTK (bug 1)."""
    recorded = pairs(data / "flockwave" / log)
    theirs = [plain(message["body"]) for pair in recorded for message in pair.notifications]
    said_again(log, recorded, world, client)
    ours = [plain(message["body"]) for message in client.notifications]
    assert all(set(message) == {"$fw.version", "id", "body"} for message in client.notifications)
    assert ours[: len(theirs)] == theirs
    if log == LOGS[1]:
        assert len(ours) == len(theirs)


@pytest.mark.data
@pytest.mark.parametrize("log", LOGS)
def test_recorded_messages_keep_to_the_schema(log: str, data: Path):
    """Every recorded answer and notification is a message of ours; of the requests those that the recorded server found right."""
    for pair in pairs(data / "flockwave" / log):
        for message in [*([pair.answer] if pair.answer else []), *pair.notifications]:
            told = msgspec.convert(message, Message)
            assert isinstance(told.body, dict)
            kind = told.body["type"].removeprefix("X-")
            msgspec.convert(told.body, ANSWERS[kind])
        try:
            request = msgspec.convert(json.loads(pair.said), Message)
        except (ValueError, msgspec.ValidationError):
            continue
        refused = pair.answer is not None and "does not match schema" in pair.answer["body"].get("reason", "")
        if isinstance(request.body, dict) and not request.body["type"].startswith("X-"):
            if refused:
                with pytest.raises(msgspec.ValidationError):
                    request_of(request.body)
            else:
                request_of(request.body)
