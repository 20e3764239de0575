"""RTKRCV's words asked of a solver among its real ingests, output and recorder: typed replies, texts, live changes, marks, screens."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.services.test_roles import RATE_HZ, World

from rtkmesh.gnss.time import GpsTime
from rtkmesh.simulation.scenario import truth
from rtkmesh_schemas.command import Code, Reply, Request
from rtkmesh_schemas.keys import CMD, EVENT, SCREEN
from rtkmesh_schemas.status import Event, Level
from rtkmesh_schemas.wire import decode, decode_json, encode_json
from rtkmesh_services.runtime.bus import Sample
from rtkmesh_services.runtime.solver_words import SOLVER_WORDS
from rtkmesh_services.solver.words import OPERATIONS

EPOCHS = 12


@pytest.fixture(scope="module")
def asked(tmp_path_factory: pytest.TempPathFactory) -> World:
    """A deployment under way, for words that change nothing."""
    world = World(tmp_path_factory.mktemp("asked"))
    world.play(EPOCHS)
    world.clock.advance(1.0)
    world.settle()
    return world


@pytest.fixture
def world(tmp_path: Path) -> World:
    world = World(tmp_path)
    world.play(EPOCHS)
    return world


def ask(world: World, process: str, op: str, /, **args: Any) -> Reply:
    """Ask with typed arguments, as a program does; the answer as JSON, as a person reads it."""
    [answer] = world.asker.get(CMD.key(process), payload=encode_json(Request(op=op, args=args)), encoding="application/json", timeout_s=1.0)
    return decode_json(Reply, answer.payload)


def events(world: World, code: str) -> list[Event]:
    found = [decode(Event, s.payload, s.encoding) for level in Level for s in world.buses["rtk"].sent(EVENT, level=level.value)]
    return [event for event in found if event.code == code]


QUIET = [word for word in OPERATIONS if word not in ("start", "stop", "restart", "load", "save", "set", "mark")]


@pytest.mark.parametrize("word", [*QUIET, "status", "help", "error", "log", "config", "metrics"])
def test_every_word_that_asks_is_answered(asked: World, word: str) -> None:
    reply = ask(asked, "rtk", word)
    assert (reply.ok, reply.code, reply.id) == (True, Code.OK, "rtk")
    assert reply.message
    if word not in ("mode", "log", "config", "metrics", "error"):
        assert reply.text.endswith("\n")


def test_status_is_typed_and_has_rtkrcvs_page(asked: World) -> None:
    reply = ask(asked, "rtk", "status")
    page = dict(line.split(": ", 1) for line in reply.text.replace(": \n", ": -\n").splitlines())
    page = {name.strip(): value for name, value in page.items()}
    assert page["rtk server state"] == "run"
    assert page["solution status"] == "fix"
    assert page["# of input data rover"].startswith(f"obs({EPOCHS}),nav(")
    assert int(page["# of valid satellites"]) >= 10
    details = reply.data["details"]
    assert 0.5 < details["dilution"]["hdop"] < details["dilution"]["gdop"] < 5.0
    assert details["missing_epochs"] == 0
    assert details["solution_interval_s"] == pytest.approx(1.0 / RATE_HZ)
    assert details["states"] > details["states_of_motion"] == 9
    assert re.fullmatch(r"1005\(\d+\).*|1006\(\d+\).*|.*107\d\(\d+\).*", page["# of rtcm messages base"])
    assert reply.data["state"] == "RUNNING"


@pytest.mark.parametrize(
    ("args", "pattern"),
    [
        ({}, r"\d{4}/\d\d/\d\d \d\d:\d\d:\d\d\.\d \(FIX   \) N:.* E:.* H: *[\d.]+ A: 0\.0 R: *[\d.]+ N:\d\d\n"),
        ({"coordinates": "deg", "flags": 3}, r".* N:\d\d\.\d{8} E: +\d+\.\d{8} H:.* \(E: .* N: .* U: .*m\) A:.*\n"),
        ({"coordinates": 2, "time": "utc", "flags": 0}, r".*:\d\d\.\d\d \(FIX   \) X:.* Y:.* Z:[ \d.]+\n"),
        ({"coordinates": "enu", "time": 3}, r"  \d{4} +\d+\.\d\d \(FIX   \) E:.* N:.* U:.*\n"),
        ({"coordinates": "pyl", "count": "3"}, r"(.* P:.* Y:.* L:.*\n){3}"),
    ],
)
def test_solutions_in_the_form_that_is_asked_for(asked: World, args: dict[str, Any], pattern: str) -> None:
    reply = ask(asked, "rtk", "solution", **args)
    assert re.fullmatch(pattern, reply.text), reply.text
    solution = reply.data["solutions"][-1]
    last = asked.solutions()[-1]
    assert (solution["status_name"], solution["tow_s"]) == ("FIX", last.tow_s)
    assert solution["position_ecef_m"] == pytest.approx(last.position_ecef_m)


@pytest.mark.parametrize(
    "args", [{"coordinates": "dmx"}, {"time": "local"}, {"count": 65}, {"count": "many"}, {"flags": 4}, {"count": True}]
)
def test_what_is_asked_wrongly_is_said(asked: World, args: dict[str, Any]) -> None:
    reply = ask(asked, "rtk", "solution", **args)
    assert (reply.ok, reply.code) == (False, Code.BAD_ARGUMENTS)
    assert next(iter(args)) in reply.message


def test_satellites_and_observations_are_those_of_the_newest_epoch(asked: World) -> None:
    satellites = ask(asked, "rtk", "satellite", frequencies="-1")
    rows = satellites.text.splitlines()
    assert rows[0] == "SAT C1    Az   El L1  Fix1  P1Res   L1Res  Sl1  Lock1 Rj1"
    assert sum(" FIX " in row for row in rows) >= 5
    assert len(satellites.data["satellite"]) == len(satellites.data["azimuth_deg"]) >= len(rows) - 1
    assert set(satellites.data["signals"]["satellite"]) <= set(satellites.data["satellite"])
    observations = ask(asked, "rtk", "observ")
    assert observations.text.count("\n") > 20
    assert set(observations.data) == {"rover", "base"}
    for epoch in observations.data.values():
        assert epoch["tow_s"] == pytest.approx(asked.solutions()[-1].tow_s)
        assert len({len(column) for name, column in epoch.items() if name not in ("week", "tow_s")}) == 1
    ephemerides = ask(asked, "rtk", "navidata").data["ephemerides"]
    assert set(satellites.data["satellite"]) <= set(ephemerides)
    assert all(told["valid"] for told in ephemerides.values())


def test_streams_are_told_by_the_processes_at_their_ends(asked: World) -> None:
    reply = ask(asked, "rtk", "stream")
    rows = {row["name"]: row for row in reply.data["streams"]}
    assert list(rows) == [line[:12].strip() for line in reply.text.splitlines()[1:]]
    assert (rows["input rover"]["type"], rows["input rover"]["format"], rows["input base"]["format"]) == ("tcpcli", "ubx", "rtcm3")
    assert rows["input rover"]["input_bytes"] == asked.status("rover").inputs[0].bytes > 1000
    assert (rows["output sol1"]["id"], rows["output sol1"]["type"], rows["output sol1"]["state"]) == ("pos", "file", "C")
    assert rows["log rover"]["path"].endswith(".ubx")
    assert rows["log rover"]["output_bytes"] > 1000
    assert (rows["log corr"]["state"], rows["monitor"]["state"]) == ("-", "-")


def test_options_are_listed_by_pattern(asked: World) -> None:
    reply = ask(asked, "rtk", "option", pattern="mask")
    assert set(reply.data["options"]) == {"elevation_mask_deg", "cn0_mask_dbhz", "ambiguity.elevation_mask_deg"}
    assert re.search(r"^ elevation_mask_deg +=15$", reply.text, re.MULTILINE)
    assert ask(asked, "rtk", "option", pattern="nothing").data["options"] == {}


def test_a_mask_is_changed_in_flight_without_losing_the_fix(world: World) -> None:
    before = world.solutions()[-1]
    reply = ask(world, "rtk", "set", name="elevation_mask_deg", value=22)
    assert (reply.ok, reply.message, reply.data["applied"]) == (True, "option elevation_mask_deg changed.", "at_once")
    assert reply.data["changes"] == {"elevation_mask_deg": {"old": 15.0, "new": 22.0}}
    assert reply.data["kept"] == ["position", "velocity", "ambiguities", "integers"]
    assert events(world, "options_changed")[-1].data["applied"] == "at_once"
    world.play(6)
    after = world.solutions()[-6:]
    assert [s.status_name for s in (before, *after)] == ["FIX"] * 7
    assert {s.resets for s in after} == {0}
    signals = ask(world, "rtk", "satellite").data["signals"]
    assert min(e for e, state in zip(signals["elevation_deg"], signals["state"], strict=True) if state & 3) >= 22.0
    told = truth("demo", seed=3)
    for solution in after:
        true = told(GpsTime(solution.week, solution.tow_s)).antennas_ecef_m["rover"]
        assert np.linalg.norm(np.subtract(solution.position_ecef_m, true)) < 0.05
    assert ask(world, "rtk", "set", name="pos1-elmask", value="15").data["applied"] == "at_once"
    assert ask(world, "rtk", "config").data["table"]["elevation_mask_deg"] == 15.0


def test_what_the_filter_cannot_take_waits_for_restart(world: World) -> None:
    reply = ask(world, "rtk", "mode", mode="single")
    assert (reply.message, reply.data["applied"]) == ("option mode changed. restart to enable it", "on_restart")
    world.play(1)
    assert world.solutions()[-1].status_name == "FIX"
    assert re.search(r"^\*mode +=single$", ask(world, "rtk", "option", pattern="mode").text, re.MULTILINE)
    assert world.lives["rtk"].status().data["options_waiting"] == 1
    assert ask(world, "rtk", "mode").data == {"mode": "kinematic", "pending": "single"}
    restarted = ask(world, "rtk", "restart")
    assert (restarted.message, restarted.text) == ("rtk server restart", "stop rtk server\nrtk server restart\n")
    world.play(2)
    assert [s.status_name for s in world.solutions()[-2:]] == ["SINGLE"] * 2
    assert ask(world, "rtk", "mode", mode="n").data["changes"] == {"mode": {"old": "single", "new": "kinematic"}}


def test_modes_are_switched_in_flight(world: World) -> None:
    """The moving base of the vehicle's two antennas becomes kinematic against the same antenna's last position, and back."""
    before = world.solutions("vector")[-1]
    assert before.status_name == "FIX"
    refused = ask(world, "rtk", "mode", mode="f")
    assert (refused.ok, "fixed_position_ecef_m" in refused.message) == (False, True)
    assert ask(world, "rtk", "mode", mode="s").data["applied"] == "at_once"
    assert ask(world, "rtk", "mode", mode="g").data["applied"] == "at_once"
    assert not ask(world, "rtk", "mode", mode="movin").ok


def test_start_and_stop_in_rtkrcvs_words(world: World) -> None:
    assert ask(world, "rtk", "start").message == "rtk server start error (server already started)"
    stopped = ask(world, "rtk", "stop")
    assert (stopped.message, stopped.text) == ("rtk server stop", "stop rtk server\nrtk server stop\n")
    assert ask(world, "rtk", "set", name="cn0_mask_dbhz", value=30).data["reason"] == "the solver is stopped"
    assert ask(world, "rtk", "mark", name="x").code is Code.WRONG_STATE
    assert ask(world, "rtk", "start").message == "rtk server start"
    assert ask(world, "rtk", "option", pattern="cn0").data["options"] == {"cn0_mask_dbhz": {"value": 30.0}}


@pytest.mark.parametrize("file", ["", "night.toml", "night.conf"])
def test_options_are_saved_and_loaded(world: World, file: str) -> None:
    ask(world, "rtk", "set", name="elevation_mask_deg", value=18)
    saved = ask(world, "rtk", "save", **({"file": file} if file else {}))
    name = file or "rtk_options.toml"
    assert saved.message == f"options saved to {name}"
    assert saved.data["bytes"] == (world.folder / name).stat().st_size
    again = ask(world, "rtk", "save", file=name)
    assert (again.ok, "overwrite=true" in again.message) == (False, True)
    assert ask(world, "rtk", "save", file=name, overwrite=True).ok
    ask(world, "rtk", "set", name="elevation_mask_deg", value=25)
    loaded = ask(world, "rtk", "load", file=name)
    assert (loaded.ok, loaded.data["applied"]) == (True, "at_once")
    assert ask(world, "rtk", "option", pattern="elevation_mask_deg").data["options"]["elevation_mask_deg"] == {"value": 18.0}
    assert loaded.text == f"options loaded from {name}\n"


def test_a_mark_is_an_event_with_time_and_place(world: World) -> None:
    reply = ask(world, "rtk", "mark", name="pole 7", comment="north\nside")
    [event] = events(world, "mark")
    last = world.solutions()[-1]
    assert (event.data["name"], event.data["comment"]) == ("pole 7", "north side")
    assert (event.data["week"], event.data["tow_s"], event.data["status"]) == (last.week, last.tow_s, 1)
    assert event.data["position_ecef_m"] == pytest.approx(last.position_ecef_m)
    assert [event.data[n] for n in ("lat_deg", "lon_deg")] == pytest.approx([last.lat_deg, last.lon_deg], abs=1e-9)
    assert event.data["height_m"] == pytest.approx(last.height_m, abs=1e-4)
    assert reply.data["name"] == "pole 7"
    assert ask(world, "rtk", "mark").data["name"] == "mark2"


def test_screens_are_published_while_somebody_looks(world: World) -> None:
    assert not world.buses["rtk"].sent(SCREEN, word="status")
    seen: dict[str, list[Sample]] = {}
    handle = world.asker.subscribe(
        SCREEN.key("rtk", word="*"), lambda sample: seen.setdefault(sample.key.split("/")[-1], []).append(sample)
    )
    epochs = int(3 * RATE_HZ)
    world.play(epochs)
    assert len(seen["solution"]) == epochs
    assert set(seen) == {"status", "satellite", "observ", "navidata", "stream", "solution"}
    for word in ("status", "satellite", "observ", "navidata", "stream"):
        assert 3 <= len(seen[word]) <= 4, "once a second"
    assert seen["status"][-1].payload.decode().startswith("Parameter                   : Value\n")
    handle.close()
    for samples in seen.values():
        samples.clear()
    world.play(epochs)
    assert not any(seen.values())


def test_errors_are_told_when_they_occur(world: World) -> None:
    seen: list[str] = []
    world.asker.subscribe(SCREEN.key("rtk", word="error"), lambda sample: seen.append(sample.payload.decode()))
    del world.streams["base"]
    for _ in range(45):
        world.clock.advance(1.0)
        world.lives["rtk"].step(0.0)
    world.play(8)
    told = ask(world, "rtk", "error", count=10)
    assert told.data["total"] >= 1
    assert [line.split(": ", 1)[0][:4] for line in told.text.splitlines()] == ["2026"] * len(told.data["errors"])
    assert "".join(seen).splitlines()[-1] == told.text.splitlines()[-1]
    assert ask(world, "rtk", "error", count=0).code is Code.BAD_ARGUMENTS


@pytest.mark.parametrize("name", ["rover", "base", "pos", "heading", "logs"])
def test_processes_without_a_word_say_which_solver_has_it(asked: World, name: str) -> None:
    near = {"rover": {"rtk", "vector"}, "base": {"rtk"}, "pos": {"rtk"}, "heading": {"vector"}, "logs": {"rtk", "vector"}}[name]
    own = asked.lives[name].service.operations
    for word in sorted(SOLVER_WORDS - set(own)):
        reply = ask(asked, name, word)
        assert (reply.ok, reply.code) == (False, Code.UNKNOWN_OP)
        assert set(re.findall(r"\b(rtk|vector)\b", reply.message)) == near
    for word in ("status", "error", "help", "config", "metrics", "log"):
        assert ask(asked, name, word).ok


def test_the_words_of_solvers_are_those_that_solvers_have() -> None:
    assert set(OPERATIONS) == SOLVER_WORDS
