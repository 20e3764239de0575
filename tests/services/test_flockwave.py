"""Flockwave at its edges: what is answered to whom by which way, what ages, what is refused, and lines that are none."""

import json
import socket
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.services.flockwave_world import BASE_A, BASE_B, PLACE, SkybrushClient, World

from rtkmesh.gnss.frames import geodetic_from_ecef
from rtkmesh_schemas.flockwave import NO_SCHEMA, Message, schema
from rtkmesh_schemas.keys import CONTROL_ID, FLOCKWAVE
from rtkmesh_schemas.observation import Observation, ReferenceMessage
from rtkmesh_schemas.status import InputStatus, ReferenceStatus, ServiceStatus, State, StreamStatus
from rtkmesh_services.control.flockwave.coordinates import coordinate, millimetres
from rtkmesh_services.control.flockwave.envelope import Question, Refusal, read_any, read_message
from rtkmesh_services.control.flockwave.server import MAXIMUM_BYTES
from rtkmesh_services.control.flockwave.statistics import BaseStatistics, Forwarding
from rtkmesh_services.control.flockwave.survey import SurveyError, SurveySettings
from rtkmesh_services.runtime.configuration import ConfigErrors, parse_deployment
from rtkmesh_services.runtime.state_files import STATE_VARIABLE
from rtkmesh_services.texts.geodesy import geodetic

S = 1_000_000_000
VERSION = {"$fw.version": "1.0"}
FIXED = {"position": [4268987123, 1178894456, 4574798789], "accuracy": 0.02}


def frame(number: int, size: int) -> bytes:
    """The bytes of a frame with a payload of ``size`` bytes; nobody here looks at its checksum."""
    return b"\xd3" + size.to_bytes(2, "big") + (number << 4).to_bytes(2, "big") + bytes(size - 2) + b"crc"


def observation(*rows: tuple[str, float]) -> Observation:
    empty = dict.fromkeys(("channel", "flags", "pseudorange_m", "phase_cyc", "doppler_hz", "lock_s"), b"")
    sigmas = {"pseudorange_sigma_m": b"", "phase_sigma_cyc": b""}
    cn0_dbhz = np.array([value for _, value in rows]).astype("<f8").tobytes()
    return Observation(
        source="base", start_id="1", sequence=0, week=2400, tow_s=0.0, satellite=[name for name, _ in rows],
        signal=["1C"] * len(rows), cn0_dbhz=cn0_dbhz, **empty, **sigmas,
    )  # fmt: skip


# Coordinates


@given(st.floats(-1.57, 1.57), st.floats(-3.14159, 3.14159), st.floats(-5000.0, 20000.0))
def test_geodetic_coordinates_are_those_of_the_engine(lat_rad: float, lon_rad: float, height_m: float):
    """Control does not load the engine, and finds the same places to a tenth of a millimetre."""
    radius = 6378137.0 / np.sqrt(1.0 - 6.69437999014e-3 * np.sin(lat_rad) ** 2)
    x, y = (radius + height_m) * np.cos(lat_rad) * np.cos(lon_rad), (radius + height_m) * np.cos(lat_rad) * np.sin(lon_rad)
    z = (radius * (1.0 - 6.69437999014e-3) + height_m) * np.sin(lat_rad)
    ours, theirs = geodetic((x, y, z)), geodetic_from_ecef(np.array([x, y, z]))
    assert np.allclose(ours[:2], theirs[:2], atol=1e-11, rtol=0.0)
    assert abs(ours[2] - height_m) < 1e-4


def test_coordinates_are_whole_numbers_as_recorded():
    """The recorded base's place, and a longitude of 180 degrees, which is -180."""
    assert coordinate(PLACE) == [461214594, 154376559, 253204, None]
    assert millimetres((4268987.123, 1178894.456, 4574798.789)) == (4268987123, 1178894456, 4574798789)
    assert coordinate((-6378137.0, 0.0, 0.0))[1] == -1_800_000_000


# Envelopes


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        (b"no json", None),
        (b"[1]", None),
        (b'{"$fw.version": "1.0", "body": {"type": "RTK-LIST"}}', None),
        (b'{"$fw.version": "1.0", "id": 5, "body": {"type": "RTK-LIST"}}', None),
        (b'{"$fw.version": "1.0", "id": "a", "refs": "b", "body": {"type": "ACK-ACK"}}', None),
        (b'{"$fw.version": "1.0", "id": "a", "refs": null, "body": {"type": "RTK-LIST"}}', Refusal(NO_SCHEMA, "a")),
        (b'{"$fw.version": "one", "id": "a", "body": {"type": "RTK-LIST"}}', Refusal(NO_SCHEMA, "a")),
        (b'{"$fw.version": "1.0", "id": "a", "body": "RTK-LIST"}', Refusal(NO_SCHEMA, "a")),
        (b'{"$fw.version": "1.0", "id": "a", "body": {}, "error": {"code": 1}}', Refusal(NO_SCHEMA, "a")),
        (b'{"$fw.version": "1.0", "id": "", "body": {"type": "RTK-LIST"}}', Refusal(NO_SCHEMA, "")),
        (b'{"id": "a", "body": {"type": "X-RTK-LIST"}}', Question({"type": "X-RTK-LIST"}, "a")),
        (b'{"$fw.version": "2", "id": "a", "body": {"type": "RTK-LIST"}, "x": 1}', Question({"type": "RTK-LIST"}, "a")),
        (b"[" * 50000, None),
        (b'"' + b"a" * MAXIMUM_BYTES + b'"', None),
        (b'{"id": "\xff"}', None),
    ],
)
def test_envelopes_are_read_refused_or_skipped(line: bytes, expected: object):
    """What has an id is answered, what has none cannot be; extended messages need no more than an id and a body."""
    assert read_message(line) == expected


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=6),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3),
    max_leaves=8,
)


@given(st.binary(max_size=200) | JSON.map(json.dumps).map(str.encode))
def test_no_bytes_make_a_reader_fail(data: bytes):
    """Whatever comes is a question, a refusal or nothing."""
    assert isinstance(read_message(data), Question | Refusal | None)
    assert isinstance(read_any(data), Question | Refusal | None)


KINDS = st.sampled_from(
    [
        "RTK-LIST",
        "RTK-INF",
        "RTK-STAT",
        "RTK-SOURCE",
        "RTK-SURVEY",
        "RTK-NEW",
        "RTK-UPDATE",
        "RTK-DEL",
        "SYS-VER",
        "CONN-INF",
        "OBJ-LIST",
        "BCN-INF",
        "BCN-PROPS",
        "CLK-INF",
        "X",
    ]
)
INNER = st.sampled_from(["accuracy", "position", "title", "sources", "format"])
FIELDS = st.sampled_from(["id", "ids", "settings", "preset", "updates", "filter", "error", "type"])


@pytest.mark.parametrize("prefix", ["", "X-"])
def test_any_body_is_answered_with_a_message(prefix: str, world: World, client: SkybrushClient):
    """Bodies of right types and any fields: each has one answer that keeps to the schema, and the connection stays."""
    bodies: list[dict[str, Any]] = []

    @given(KINDS, st.dictionaries(FIELDS, JSON | st.dictionaries(INNER, JSON)))
    def gather(kind: str, fields: dict[str, Any]) -> None:
        bodies.append({**fields, "type": prefix + kind})

    gather()
    for number, body in enumerate(bodies):
        client.say({**VERSION, "id": f"f{number}", "body": body})
    client.silence()
    answered = {line["refs"]: line for line in client.lines}
    assert {f"f{number}" for number in range(len(bodies))} <= set(answered)
    for line in answered.values():
        msgspec.convert(line, Message)


# Connections


def test_bad_lines_never_end_a_connection(world: World, client: SkybrushClient):
    """Noise, a line that is far too long, cut JSON and foreign bytes: skipped, and the next request is answered."""
    for noise in (b"", b"\x00\xff\xfe", b"{", b"x" * (3 * MAXIMUM_BYTES), b'{"id": ["a"]}', b"\r", b"GET / HTTP/1.1"):
        client.say(noise)
        assert client.ask_body("RTK-LIST") == {"type": "RTK-LIST", "ids": ["base-a", "base-b"]}


def test_lines_may_come_in_pieces_and_many_at_once(world: World, client: SkybrushClient):
    """A request is answered when its end comes, several in one packet each for itself."""
    line = json.dumps({**VERSION, "id": "p", "body": {"type": "RTK-LIST"}}).encode() + b"\n"
    for byte in line[:-1]:
        client.socket.send(bytes((byte,)))
    client.socket.send(line[-1:] + line.replace(b'"p"', b'"q"') + line.replace(b'"p"', b'"r"'))
    world.until(lambda: client.read() or {row["refs"] for row in client.lines} >= {"p", "q", "r"})


def test_clients_are_many_and_each_gets_its_own_answers(world: World):
    """Answers go to who asked, notifications to all."""
    clients = [SkybrushClient(world) for _ in range(5)]
    assert clients[0].ask_body("RTK-SOURCE", id="base-a") == {"type": "ACK-ACK"}
    for client in clients:
        assert client.ask_body("RTK-SOURCE") == {"type": "RTK-SOURCE", "id": "base-a"}
        world.until(lambda client=client: client.read() or len(client.notifications) >= 2)
        assert [message["body"]["status"]["rtk:base-a"]["status"] for message in client.notifications] == ["connecting", "connected"]
    assert [len(client.lines) for client in clients] == [2, 1, 1, 1, 1]
    for client in clients:
        client.close()


def test_too_many_clients_are_refused_and_those_who_are_there_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A connection beyond the limit is closed at once."""
    monkeypatch.setenv(STATE_VARIABLE, str(tmp_path))
    world = World(tmp_path, maximum_clients=1)
    client = SkybrushClient(world)
    client.silence()
    with socket.create_connection(world.address) as second:
        second.settimeout(10.0)
        assert second.recv(10) == b""
    client.silence()
    client.close()
    world.close()


def test_a_client_that_does_not_read_is_let_go_and_holds_up_nobody(world: World, client: SkybrushClient):
    """Its answers pile up to a megabyte, then it is dropped; the other one is answered all the while."""
    server = world.lives["control"].service._flockwave.server
    with socket.create_connection(world.address) as deaf:
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        deaf.setblocking(False)
        request = json.dumps({**VERSION, "id": "d", "body": {"type": "RTK-INF", "ids": [f"{n:060d}" for n in range(900)]}}).encode() + b"\n"

        def is_dropped() -> bool:
            try:
                deaf.send(request)
            except BlockingIOError:
                pass
            except OSError:
                return True
            return server.counters["clients_stalled"] > 0

        world.until(is_dropped)
    assert client.ask_body("SYS-PING") == {"type": "ACK-ACK"}


def test_datagrams_are_answered_and_their_senders_told(world: World, client: SkybrushClient):
    """By UDP: one message each, bad ones skipped, and notifications for who was heard."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.setblocking(False)
        got: list[dict[str, Any]] = []

        def receive() -> list[dict[str, Any]]:
            with suppress(BlockingIOError):
                got.append(json.loads(peer.recv(65536)))
            return got

        peer.sendto(b"noise", world.address)
        peer.sendto(json.dumps({**VERSION, "id": "u", "body": {"type": "X-RTK-LIST"}}).encode(), world.address)
        world.until(receive)
        assert (got[0]["refs"], got[0]["body"]) == ("u", {"type": "X-RTK-LIST", "ids": ["base-a", "base-b"]})
        client.ask_body("RTK-SOURCE", id="base-b")
        world.until(lambda: len(receive()) >= 2)
        assert got[1]["body"]["type"] == "CONN-INF"


def test_zenoh_is_answered_in_kind(world: World):
    """``rtk/flockwave``: a bare body has a bare answer, an envelope an envelope, and nonsense is refused."""

    def ask(payload: bytes, parameters: str = "") -> Any:
        [answer] = world.asker.get(FLOCKWAVE.key(CONTROL_ID) + parameters, payload=payload, timeout_s=1.0)
        assert (answer.ok, answer.encoding) == (True, "application/json")
        return json.loads(answer.payload)

    assert ask(b'{"type": "RTK-SOURCE"}') == {"type": "RTK-SOURCE", "id": None}
    assert ask(b"", "?type=RTK-LIST")["ids"] == ["base-a", "base-b"]
    enveloped = ask(json.dumps({**VERSION, "id": "z", "body": {"type": "RTK-SOURCE"}}).encode())
    assert (enveloped["refs"], enveloped["body"]["type"]) == ("z", "RTK-SOURCE")
    for nonsense in (b"noise", b"{}", b'{"type": 5}', b'{"type": "RTK-INF"}', b"[]"):
        assert ask(nonsense) == {"type": "ACK-NAK", "reason": NO_SCHEMA}
    assert ask(b"", "?x=1")["reason"] == NO_SCHEMA


# What is asked


def test_a_skybrush_client_gets_along(world: World, client: SkybrushClient):
    """What Skybrush Live asks after it has connected: answered, or refused in the words that it tolerates."""
    client.ask_body("RTK-SOURCE", id="base-a")
    world.stream(BASE_A, 0.0, 0.5)
    assert client.ask_body("CONN-LIST")["ids"] == ["rtk:base-a"]
    information = client.ask_body("CONN-INF", ids=["rtk:base-a", "radio"])
    assert information["status"]["rtk:base-a"]["status"] == "connected"
    assert information["error"] == {"radio": "No such connection"}
    assert client.ask_body("OBJ-LIST")["ids"] == client.ask_body("OBJ-LIST", filter=["beacon", "dock"])["ids"] == ["rtk::base_0"]
    assert client.ask_body("OBJ-LIST", filter=["uav"])["ids"] == []
    assert client.ask_body("BCN-INF", ids=["rtk::base_0"])["status"]["rtk::base_0"]["position"][:2] == [461214594, 154376559]
    assert client.ask_body("BCN-PROPS", ids=["rtk::base_0"])["result"]["rtk::base_0"]["name"] == "RTK base station (Base A)"
    assert client.ask_body("CLK-LIST") == {"type": "CLK-LIST", "ids": []}
    assert client.ask_body("CLK-INF", ids=["gps"]) == {"type": "CLK-INF", "status": {}, "error": {"gps": "No such clock"}}
    assert client.ask_body("AUTH-INF") == {"type": "AUTH-INF", "methods": [], "required": False}
    assert client.ask_body("AUTH-WHOAMI") == {"type": "AUTH-WHOAMI", "user": ""}
    assert client.ask_body("DOCK-INF", ids=[])["reason"] == "No handler managed to parse this message in the server"


def test_presets_are_made_changed_and_deleted(world: World, client: SkybrushClient):
    """A user's preset through its life; its password is never shown, and outlives a client that sends back what it was shown."""
    secret = "ntrip://u:p@127.0.0.1:2101/MP"
    name = client.ask_body("X-RTK-NEW", preset={"title": "My NTRIP", "source": secret})["id"]
    shown = client.ask_body("RTK-INF", ids=[name])["preset"][name]
    assert (shown["title"], shown["type"], shown["format"]) == ("My NTRIP", "user", "auto")
    assert shown["sources"] == ["ntrip://u:***@127.0.0.1:2101/MP"]
    changes = {name: {"title": "Other", "sources": shown["sources"]}}
    assert client.ask_body("X-RTK-UPDATE", ids=[name], updates=changes)["result"] == {name: True}
    preset = world.lives["control"].service._bases.book.get(name)
    assert (preset.title, preset.sources) == ("Other", (secret,))
    assert client.ask_body("X-RTK-UPDATE", ids=[name])["error"] == {name: "Preset does not match expected schema"}
    assert client.ask_body("X-RTK-SAVE") == {"type": "ACK-ACK"}
    assert client.ask_body("X-RTK-DEL", ids=[name, name]) == {"type": "X-RTK-DEL", "result": {name: True}}
    assert client.ask_body("RTK-INF", ids=[name])["error"] == {name: "No such RTK preset"}
    refusals = [client.ask_body("X-RTK-NEW", preset=preset)["reason"] for preset in ([], None, {"type": "user"}, {"sources": [5]})]
    assert refusals[:3] == ["Preset does not match expected schema"] * 2 + ["Preset must not have a type"]
    assert refusals[3].startswith("Preset does not match expected schema")


def test_the_source_may_change_any_number_of_times(world: World, client: SkybrushClient):
    """Their bug 1: going from one base to another directly ended all of RTK. Statistics are those of the selected base alone."""
    for name in ("base-a", "base-b", "base-a", "base-a", "base-b"):
        assert client.ask_body("RTK-SOURCE", id=name) == {"type": "ACK-ACK"}
        assert client.ask_body("RTK-SOURCE")["id"] == name
    world.stream(BASE_A, 0.0, 1.5)
    told = client.ask_body("RTK-STAT")
    assert (told["messages"], told["cnr"], told["antenna"]) == ({}, {}, {})
    world.stream(BASE_B, 0.0, 1.5)
    assert client.ask_body("RTK-STAT")["messages"]["rtcm3/1077"][1] == 8.0 * 80 * 2 / 10


def test_a_selection_by_others_is_followed(world: World, client: SkybrushClient):
    """Who selects by other means than Flockwave is seen by its clients too."""
    world.lives["control"].service._bases.book.select("base-b")
    world.advance(0.2)
    assert client.ask_body("RTK-SOURCE")["id"] == "base-b"
    assert client.notifications[0]["body"]["status"]["rtk:base-b"]["description"] == "RTK corrections (Base B)"


# Surveys


def test_settings_reach_the_receiver_and_count_when_it_was_told(world: World, client: SkybrushClient):
    """RTK-SURVEY on a u-blox: the messages that it sends, then TMODE3 as recorded; the position stays until the source is chosen anew."""
    puppet = world.puppets[BASE_B]
    client.ask_body("RTK-SOURCE", id="base-b")
    assert client.ask_body("X-RTK-SURVEY", settings={"duration": 30, "accuracy": 0.5, "messageSet": "msm4", "gnssTypes": ["gps"]}) == {
        "type": "ACK-ACK"
    }
    world.advance(0.5)
    survey = "b562067128000000010000000000000000000000000000000000000000001e0000008813000000000000000000"
    assert puppet.told[-1].hex().startswith(survey)
    rates = {told[7]: told[9] for told in puppet.told if told[2:4] == b"\x06\x01" and told[6] == 0xF5}
    assert rates == {0x05: 5, 0x4A: 1, 0x4D: 0, 0x54: 0, 0x57: 0, 0x5E: 0, 0x61: 0, 0x7C: 0, 0x7F: 0, 0xE6: 0}
    assert client.ask_body("X-RTK-SURVEY", settings=FIXED) == {"type": "ACK-ACK"}
    world.advance(1.1)
    fixed = "b562067128000000020018f57119a5d90607c696441b1e3c5a00c8000000"
    assert puppet.told[-1].hex().startswith(fixed)
    told = client.ask_body("RTK-STAT")
    assert told["survey"] == {"accuracy": 0.02, "flags": 5}
    assert told["antenna"]["positionECEF"] == FIXED["position"]
    client.ask_body("X-RTK-SURVEY", settings={"accuracy": 3.0})
    assert client.ask_body("RTK-SURVEY")["settings"]["accuracy"] == 0.02, "a position that stands keeps its accuracy"
    client.ask_body("RTK-SOURCE", id="base-b")
    settings = client.ask_body("RTK-SURVEY")["settings"]
    assert "position" not in settings
    assert settings["accuracy"] == 0.5


def test_what_the_ingest_refuses_is_answered_with_its_reason(world: World, client: SkybrushClient):
    """An accuracy that the base station cannot be told: nothing is set."""
    client.ask_body("RTK-SOURCE", id="base-b")
    refusal = client.ask_body("X-RTK-SURVEY", settings={"accuracy": 1e6})
    assert refusal == {"type": "ACK-NAK", "reason": "accuracy_m is a number from 0.001 to 100"}
    assert client.ask_body("RTK-SURVEY")["settings"] == {"accuracy": 1.0, "duration": 60, "messageSet": "msm7"}


def test_an_ingest_that_is_gone_is_said_to_be(world: World, client: SkybrushClient):
    """A preset whose process does not answer: the reason says so, and others are answered meanwhile."""
    world.lives["control"].service._flockwave._ingest_of = lambda _: "nobody"
    client.ask_body("RTK-SOURCE", id="base-b")
    client.say({**VERSION, "id": "slow", "body": {"type": "RTK-SURVEY", "settings": {"accuracy": 1, "duration": 60}}})
    assert client.ask_body("SYS-PING") == {"type": "ACK-ACK"}
    assert "slow" not in {line["refs"] for line in client.lines}
    [answer] = world.until(lambda: client.read() or [line for line in client.lines if line["refs"] == "slow"])
    assert answer["body"]["reason"].startswith("no process 'nobody' is on the network")


@pytest.mark.parametrize(
    ("update", "reason"),
    [
        ([1], "Settings object missing or invalid"),
        ({"accuracy": 0}, "invalid accuracy"),
        ({"accuracy": "1"}, "invalid accuracy"),
        ({"accuracy": True}, "invalid accuracy"),
        ({"duration": -5}, "invalid duration"),
        ({"duration": None}, "invalid duration"),
        ({"duration": 10**400}, "invalid duration"),
        ({"messageSet": "msm9"}, "'msm9' is not a valid RTKMessageSet"),
        ({"messageSet": ["msm4"]}, "\"['msm4']\" is not a valid RTKMessageSet"),
        ({"position": [1, 2]}, "invalid base station position"),
        ({"position": [1, 2, "3"]}, "invalid base station position"),
        ({"position": "here"}, "invalid base station position"),
        ({"gnssTypes": ["gps", "gsp"]}, "invalid GNSS type list"),
        ({"gnssTypes": "gps"}, "invalid GNSS type list"),
        ({"gnssTypes": [5]}, "invalid GNSS type list"),
        ({"duration": 10, "accuracy": -1}, "invalid accuracy"),
    ],
)
def test_wrong_settings_are_refused_whole(update: Any, reason: str):
    """In the recorded words."""
    with pytest.raises(SurveyError) as caught:
        SurveySettings().changed(update)
    assert str(caught.value) == reason


def test_settings_are_merged():
    """Updates go into what there is; types are sorted, each once; null ends a position and brings back the goal of surveys."""
    settings = SurveySettings().changed({"accuracy": 0.5, "gnssTypes": ["gps", "galileo", "gps"]}).changed(FIXED)
    assert (settings.gnss_types, settings.accuracy_m, settings.goal_m) == (("galileo", "gps"), 0.02, 0.5)
    ended = settings.changed({"position": None, "duration": 5})
    assert (ended.position_ecef_m, ended.accuracy_m, ended.duration_s) == (None, 0.5, 5.0)
    assert settings.changed({"position": None, "accuracy": 2}).goal_m == 2.0
    assert ended.changed({"gnssTypes": None}).gnss_types == ()


# Statistics


def test_bit_rates_are_of_the_last_ten_seconds_and_entries_stay():
    """Always divided by ten seconds; a message that comes no more keeps its entry, its age grows, its rate goes to zero."""
    statistics = BaseStatistics(Forwarding(reject=("rtcm3/1077",)))
    for second in range(5):
        statistics.frame(frame(1077, 100), second * S)
    statistics.frame(frame(1008, 28), 4 * S)
    statistics.frame(b"\xb5\x62 no RTCM", 4 * S)
    told = statistics.answer("RTK-STAT", 4 * S + S // 2)
    assert told.messages == {"rtcm3/1077": (500, 8 * 500 / 10), "rtcm3/1008": (500, 8 * 28 / 10)}
    assert told.messages_tx == {}, "one is rejected, the other not of the basic set"
    later = statistics.answer("RTK-STAT", 12 * S + 1)
    assert later.messages["rtcm3/1077"] == (8000, 8 * 200 / 10)
    assert statistics.answer("RTK-STAT", 100 * S).messages["rtcm3/1077"] == (96000, 0.0)


@pytest.mark.parametrize(
    ("forwarding", "passed"),
    [
        (Forwarding(), {1005, 1077, 1230}),
        (Forwarding(basic=False), {1005, 1008, 1077, 1230, 4072}),
        (Forwarding(accept=("rtcm3/1077", "rtcm3/4072")), {1077}),
        (Forwarding(accept=("rtcm3/1077", "rtcm3/1005"), reject=("rtcm3/1005",), basic=False), {1077}),
    ],
)
def test_messages_are_forwarded_by_filter_and_set(forwarding: Forwarding, passed: set[int]):
    """Reject goes first, then accept, then the set."""
    assert {number for number in (1005, 1008, 1077, 1230, 4072) if forwarding.passes(number)} == passed


def test_strengths_are_of_the_strongest_signal_for_fifteen_seconds():
    """Letters as Flockwave has them: J is Q, others than GREQC are left out; what says nothing is no strength."""
    statistics = BaseStatistics(Forwarding())
    rows = (("G05", 30.0), ("G05", 41.5), ("J02", 44.0), ("S20", 40.0), ("I03", 40.0), ("E11", float("nan")), ("R07", 0.0), ("C23", 33.0))
    statistics.epoch(observation(*rows), 0)
    statistics.epoch(observation(("G05", 20.0)), 5 * S)
    assert statistics.answer("RTK-STAT", 15 * S).cnr == {"C23": 33.0, "G05": 20.0, "Q02": 44.0}
    assert statistics.answer("RTK-STAT", 15 * S + 1).cnr == {"G05": 20.0}
    statistics.epoch(msgspec.structs.replace(observation(("G01", 1.0), ("G02", 2.0)), cn0_dbhz=b"short"), 16 * S)
    assert statistics.answer("RTK-STAT", 16 * S).cnr == {"G05": 20.0}


def reference(origin: str = "rtcm3", **fields: Any) -> ReferenceMessage:
    return ReferenceMessage(source="base", start_id="1", sequence=0, station_id=7, origin=origin, **fields)


def status(data: dict[str, Any] | None = None, stream: StreamStatus | None = None) -> ServiceStatus:
    rows = [InputStatus(name="tcp", state="connected", stream=stream)]
    return ServiceStatus(id="base", role="ingest", state=State.RUNNING, start_id="1", heartbeat=1, inputs=rows, data=data or {})


def test_a_position_is_forgotten_after_thirty_seconds_and_the_antenna_stays():
    """Counted from the last 1005 or 1006, also where it says nothing new."""
    statistics = BaseStatistics(Forwarding())
    statistics.reference(reference(position_ecef_m=PLACE, antenna="LEIAR25"), 0)
    statistics.frame(frame(1006, 21), 10 * S)
    assert statistics.position(40 * S) == PLACE
    assert statistics.position(40 * S + 1) is None
    antenna = statistics.antenna(41 * S)
    assert msgspec.to_builtins(antenna) == {"stationId": 7, "descriptor": "LEIAR25"}


def test_a_configured_position_needs_no_message_and_the_streams_goes_before_it():
    """Without 1005 the ingest's own word counts, for ever; where the stream says a place, that is told, as rovers get it."""
    statistics = BaseStatistics(Forwarding())
    statistics.reference(reference("configuration", position_ecef_m=PLACE), 0)
    assert statistics.position(1000 * S) == PLACE
    other = (PLACE[0] + 1.0, *PLACE[1:])
    statistics.status(status(stream=StreamStatus(reference=ReferenceStatus(position_ecef_m=other, age_s=3.0))), 1000 * S)
    assert statistics.position(1001 * S) == other
    assert statistics.position(1028 * S) is None


@pytest.mark.parametrize(
    ("data", "flags", "accuracy"),
    [
        ({}, 0, 0.0),
        ({"base_station": {"mode": "watch", "state": "watching", "supported": True}}, 0, 0.0),
        ({"base_station": {"mode": "survey-in", "state": "surveying", "supported": True, "active": True, "accuracy_m": 2.5}}, 3, 2.5),
        ({"base_station": {"mode": "survey-in", "state": "surveyed", "valid": True, "accuracy_m": 0.9}}, 5, 0.9),
        ({"base_station": {"mode": "fixed", "state": "fixed", "valid": False, "accuracy_m": 0.02}}, 1, 0.02),
        ({"base_station": {"mode": 5}, "survey_in": {"active": True, "valid": False, "accuracy_m": 7.5}}, 3, 7.5),
        ({"survey_in": {"active": False, "valid": True, "accuracy_m": None}}, 5, 0.0),
        ({"survey_in": {"active": False, "valid": False, "accuracy_m": 7.5}}, 0, 0.0),
        ({"survey_in": "none"}, 0, 0.0),
    ],
)
def test_surveys_are_told_by_their_flags(data: dict[str, Any], flags: int, accuracy: float):
    """Supported, active, valid: by the base station's word, else by the receiver's own."""
    statistics = BaseStatistics(Forwarding())
    statistics.status(status(data), 0)
    told = statistics.answer("RTK-STAT", S).survey
    assert (told.flags, told.accuracy) == (flags, accuracy)


def test_a_beacon_without_word_is_inactive_and_goes_with_its_base(world: World, client: SkybrushClient):
    """Fifteen seconds after the last position."""
    client.ask_body("RTK-SOURCE", id="base-a")
    world.stream(BASE_A, 0.0, 0.5)
    world.advance(15.2)
    client.ask_body("RTK-SOURCE", id=None)
    client.silence()
    bodies = [message["body"] for message in client.notifications]
    active = [body["status"]["rtk::base_0"]["active"] for body in bodies if body["type"] == "BCN-INF"]
    assert active == [True, False]
    assert [body["type"] for body in bodies][-3:] == ["CONN-DEL", "OBJ-DEL", "CONN-INF"]
    assert client.ask_body("RTK-STAT")["antenna"] == {}


# Configuration and schema


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('tcp = "0.0.0.0:5001"', "is no loopback address; others could command your bases: say insecure = true to allow it"),
        ('udp = "[::]:5001"', "is no loopback address"),
        ('tcp = "5001"', "is no HOST:PORT"),
        ('tcp = "::1:5001"', "is no HOST:PORT"),
        ('tcp = "localhost:70000"', "the port is none from 1 to 65535"),
        ('tpc = "localhost:5001"', "did you mean 'tcp'?"),
    ],
)
def test_wrong_addresses_are_told_with_their_line(text: str, message: str):
    """As all faults of a deployment file."""
    with pytest.raises(ConfigErrors) as caught:
        parse_deployment(f"[flockwave]\n{text}\n", "site.toml")
    assert str(caught.value).startswith("site.toml:2: [flockwave]")
    assert message in str(caught.value)


def test_right_addresses_are_taken():
    """Loopback, and others where it is said."""
    for text in ('tcp = "127.0.0.1:5001"\nudp = "[::1]:5001"', 'tcp = "0.0.0.0:5001"\ninsecure = true'):
        parse_deployment(f"[flockwave]\n{text}\n", "site.toml")


def test_every_type_in_the_schema_is_defined():
    """No reference of the JSON Schema leads nowhere."""
    text = json.dumps(schema())
    defined = schema()["$defs"]
    assert {part.partition('"')[0] for part in text.split("#/$defs/")[1:]} <= set(defined)
    assert defined["Body" if "Body" in defined else "Statistics"]["additionalProperties"] is False
