"""A base station on a pseudo-terminal: surveys, told positions, what is saved, and what is said when it has moved."""

import json
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from tests.patience import PATIENCE_S, SteadyClock
from tests.services.simulated_receiver import PLACE, SimulatedReceiver, key, running
from tests.services.simulated_text_receivers import SimulatedMosaic, SimulatedUnicore, TextReceiver

from rtkmesh.gnss.ephemeris import ReferenceStation
from rtkmesh_schemas.base import SurveyStatus
from rtkmesh_schemas.command import Code, Reply
from rtkmesh_schemas.config import BaseStationTable, Deployment, IngestTable
from rtkmesh_schemas.keys import CMD, EVENT, REF, STATUS, Role
from rtkmesh_schemas.observation import ReferenceMessage
from rtkmesh_schemas.status import Event, ServiceStatus, State
from rtkmesh_schemas.wire import decode
from rtkmesh_services.ingest.base import station
from rtkmesh_services.ingest.base.found import Found
from rtkmesh_services.ingest.base.presets import PresetStore
from rtkmesh_services.ingest.receivers import orders
from rtkmesh_services.ingest.service import IngestService
from rtkmesh_services.runtime.lifecycle import Lifecycle
from rtkmesh_services.runtime.memory_bus import MemoryBus, MemoryNetwork
from rtkmesh_services.runtime.service import Context
from rtkmesh_services.runtime.state_files import STATE_VARIABLE


class Base:
    """An ingest with a base station, in this process; its receiver is real bytes away."""

    def __init__(self, path: str, **table: Any) -> None:
        self.table = IngestTable(source=f"serial://{path}", base_station=msgspec.convert({"receiver": "ublox", **table}, BaseStationTable))
        network = MemoryNetwork()
        network.on_wait = lambda: self.life.step(0.005)
        self.bus = MemoryBus("base", network)
        self.asker = MemoryBus("asker", network)
        deployment = Deployment(ingest={"base": self.table})
        context = Context(id="base", role=Role.INGEST, deployment=deployment, bus=self.bus, clock=SteadyClock())
        self.life = Lifecycle(IngestService(context), warm_in_thread=False)
        self.life.start()
        self.life.step(0.0)  # it opens

    def until(self, condition: Callable[[], Any]) -> Any:
        deadline_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline_s:
            self.life.step(0.005)
            if found := condition():
                return found
        raise AssertionError(f"never; {self.status()}, {[event.text for event in self.events()]}")

    def until_state(self, *states: str) -> SurveyStatus:
        return self.until(lambda: (found := self.survey()).state in states and found)

    def until_event(self, code: str) -> Event:
        return self.until(lambda: next((event for event in self.events() if event.code == code), None))

    def events(self) -> list[Event]:
        levels = ("info", "warning", "error")
        found = [decode(Event, sample.payload) for level in levels for sample in self.bus.sent(EVENT, level=level)]
        return sorted(found, key=lambda event: event.sequence)

    def codes(self) -> list[str]:
        return [event.code for event in self.events()]

    def status(self) -> ServiceStatus:
        return decode(ServiceStatus, self.bus.sent(STATUS)[-1].payload)

    def survey(self) -> SurveyStatus:
        return msgspec.convert(self.ask("survey_status").data, SurveyStatus)

    def reference(self) -> ReferenceMessage | None:
        sent = self.bus.sent(REF)
        return decode(ReferenceMessage, sent[-1].payload) if sent else None

    def ask(self, op: str, **arguments: Any) -> Reply:
        payload = json.dumps({"op": op, "args": arguments}).encode()
        [answer] = self.asker.get(CMD.key("base"), payload=payload, encoding="application/json", timeout_s=1.0)
        return decode(Reply, answer.payload, answer.encoding)

    def close(self) -> None:
        self.life.service.close()


@pytest.fixture
def receiver() -> Iterator[SimulatedReceiver]:
    with running(SimulatedReceiver()) as found:
        yield found


@pytest.fixture
def make(receiver: SimulatedReceiver, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Base]]:
    monkeypatch.setenv(STATE_VARIABLE, str(tmp_path))
    made: list[Base] = []

    def new(**table: Any) -> Base:
        made.append(Base(receiver.path, **table))
        return made[-1]

    yield new
    for base in made:
        base.close()


Make = Callable[..., Base]


def near(position: Any, place: Any = PLACE, within_m: float = 2e-4) -> bool:
    return position is not None and max(abs(a - b) for a, b in zip(position, place, strict=True)) < within_m


def test_a_survey_is_begun_watched_published_and_saved(receiver: SimulatedReceiver, make: Make):
    base = make(mode="survey-in", minimum_s=40, accuracy_m=1.0, preset="roof", datum="WGS 84")
    seen = base.until(lambda: (found := base.survey()).state == "surveying" and found.observations > 5 and found)
    assert (seen.active, seen.valid, seen.supported) == (True, False, True)
    assert seen.accuracy_m is not None
    assert seen.accuracy_m > 0.5
    done = base.until_state("surveyed")
    assert (done.valid, done.active, done.source) == (True, False, "survey-in")
    assert done.observations >= 40
    assert near(done.position_ecef_m)
    assert receiver.value("CFG_TMODE_SVIN_MIN_DUR") == 40
    assert receiver.value("CFG_TMODE_SVIN_ACC_LIMIT") == 10000
    base.until(lambda: (ref := base.reference()) and ref.origin == "rtcm3" and near(ref.position_ecef_m))
    saved = PresetStore().get("roof")
    assert saved is not None
    assert near(saved.position_ecef_m)
    assert (saved.source, saved.datum, saved.observations) == ("survey-in", "WGS 84", done.observations)
    assert [code for code in base.codes() if code.startswith(("survey", "base"))] == ["survey_started", "survey_done", "base_saved"]
    base.until(lambda: base.status().data["base_station"]["state"] == "surveyed")
    assert base.status().state is State.RUNNING


def test_orders_that_are_not_answered_are_said_again(receiver: SimulatedReceiver, make: Make, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(orders, "FIRST_PATIENCE_S", 0.3)
    receiver.deaf = 2
    make(mode="survey-in", minimum_s=5, accuracy_m=5.0).until_state("surveyed")
    assert receiver.heard["ubx/06-8a"] == 4, "two unheard, two of the survey"


def test_a_receiver_that_refuses_is_named_and_asked_again(receiver: SimulatedReceiver, make: Make, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(station, "FIRST_RETRY_S", 0.5)
    receiver.refused = frozenset({"CFG_TMODE_SVIN_MIN_DUR"})
    base = make(mode="survey-in", minimum_s=5, accuracy_m=5.0)
    event = base.until_event("base_failed")
    assert event.text.startswith("CFG-VALSET: refused (ACK-NAK); trying again in 0 s")
    base.until(lambda: base.status().state is State.DEGRADED and "refused" in base.status().reason)
    receiver.refused = frozenset()
    base.until_state("surveyed")
    base.until(lambda: base.status().state is State.RUNNING)


def test_a_survey_that_is_done_is_not_begun_again(receiver: SimulatedReceiver, make: Make):
    """Not even by another process: the position of a base must not change with every restart."""
    first = make(mode="survey-in", minimum_s=5, accuracy_m=5.0)
    first.until_state("surveyed")
    first.close()
    told = receiver.heard["ubx/06-8a"]
    second = make(mode="survey-in", minimum_s=5, accuracy_m=5.0)
    second.until_state("surveyed")
    assert receiver.heard["ubx/06-8a"] == told
    assert "survey_started" not in second.codes()


def test_a_known_position_is_told(receiver: SimulatedReceiver, make: Make):
    base = make(mode="fixed", position_ecef_m=PLACE, accuracy_m=0.02)
    base.until_state("fixed")
    assert (receiver.mode, receiver.value("CFG_TMODE_FIXED_POS_ACC")) == (2, 200)
    assert near(receiver.position(), within_m=6e-5)
    ref = base.reference()
    assert ref is not None
    assert (ref.position_ecef_m, ref.origin) == (PLACE, "configuration")


def surveyed_and_cold(receiver: SimulatedReceiver, make: Make) -> None:
    """A first run surveys and saves the roof; then the receiver loses its power."""
    first = make(mode="preset", preset="roof", minimum_s=5, accuracy_m=5.0)
    first.until_state("surveyed")
    first.close()
    receiver.power_cycle()


def test_a_position_and_its_messages_are_told_by_command(receiver: SimulatedReceiver, make: Make):
    """As Flockwave's settings do: MSM4 of two systems, then the position; a receiver that lacks one of the messages is told the rest."""
    receiver.refused = frozenset({"CFG_MSGOUT_RTCM_3X_TYPE1124_USB"})
    base = make(mode="watch")
    base.until_state("watching")
    arguments = {"position_ecef_m": list(PLACE), "accuracy_m": 0.05, "messages": "msm4", "systems": "GE"}
    assert base.ask("fix_position", **arguments).code is Code.ACCEPTED
    base.until_state("fixed")
    assert near(receiver.position())
    assert receiver.value("CFG_TMODE_FIXED_POS_ACC") == 500
    numbers = (1005, 1074, 1077, 1084, 1087, 1094, 1097, 1124, 1230)
    rates = {number: receiver.value(f"CFG_MSGOUT_RTCM_3X_TYPE{number}_USB") for number in numbers}
    assert rates == {1005: 5, 1074: 1, 1077: 0, 1084: 0, 1087: 0, 1094: 1, 1097: 0, 1124: 0, 1230: 0}
    assert base.ask("survey_start", messages="msm7").ok
    base.until_state("surveying")
    assert [receiver.value(f"CFG_MSGOUT_RTCM_3X_TYPE{number}_UART1") for number in (1074, 1077, 1087, 1230)] == [0, 1, 1, 5]


def test_a_preset_is_surveyed_once_and_then_told(receiver: SimulatedReceiver, make: Make):
    """The second start finds a receiver that has lost its power: its fixes agree with what is saved, so it is told that."""
    surveyed_and_cold(receiver, make)
    receiver.bias_m = 1.4
    second = make(mode="preset", preset="roof", check_s=1)
    second.until_state("fixed")
    assert receiver.mode == 2
    assert near(receiver.position())
    assert "base_consistent" in second.codes()
    ref = second.reference()
    assert ref is not None
    assert (near(ref.position_ecef_m), ref.origin) == (True, "preset")
    second.close()
    told = receiver.heard["ubx/06-8a"]
    third = make(mode="preset", preset="roof", check_s=1)
    third.until_state("fixed")
    assert receiver.heard["ubx/06-8a"] == told, "it sends the position already"


def test_a_base_that_was_carried_away_is_not_told_its_old_place(receiver: SimulatedReceiver, make: Make):
    surveyed_and_cold(receiver, make)
    receiver.bias_m = 60.0
    second = make(mode="preset", preset="roof", check_s=1)
    event = second.until_event("base_moved")
    assert event.level == "error"
    assert event.data["kind"] == "fix"
    assert event.data["enu_m"] == pytest.approx([60.0, 0.0, 0.0], abs=0.02)
    assert re.match(r"the base has moved: (60.0|59.9)\d m from the saved position 'roof' of 20", event.text)
    second.until(lambda: second.status().state is State.DEGRADED and "the base has moved" in second.status().reason)
    survey = second.survey()
    assert (survey.state, survey.valid, survey.moved_m) == ("failed", False, pytest.approx(60.0, abs=0.02))
    assert receiver.mode == 0
    saved = PresetStore().get("roof")
    assert saved is not None
    assert near(saved.position_ecef_m), "what is saved stays"
    assert second.ask("use_preset", name="roof", unchecked=True).code is Code.ACCEPTED
    second.until_state("fixed")
    assert receiver.mode == 2


def test_a_new_survey_elsewhere_is_an_error_until_it_is_saved(receiver: SimulatedReceiver, make: Make):
    PresetStore().save(Found(PLACE, 0.5, "survey-in", 60.0, 60).saved_as("roof", 0, "test", ReferenceStation(7)))
    receiver.bias_m = -25.0
    base = make(mode="survey-in", preset="roof", minimum_s=5, accuracy_m=5.0)
    assert base.until_event("base_moved").data["kind"] == "survey"
    base.until(lambda: base.status().state is State.DEGRADED)
    refused = base.ask("save_preset", name="roof")
    assert (refused.ok, refused.code) == (False, Code.WRONG_STATE)
    assert "say replace" in refused.message
    replaced = base.ask("save_preset", name="roof", replace=True, antenna="LEIAR25.R3 LEIT", antenna_height_m=0.12)
    assert near(replaced.data["replaced"]["position_ecef_m"])
    assert not near(replaced.data["position"]["position_ecef_m"], within_m=10.0)
    assert (replaced.data["position"]["antenna"], replaced.data["position"]["antenna_height_m"]) == ("LEIAR25.R3 LEIT", 0.12)
    base.until(lambda: base.status().state is State.RUNNING)
    preset = PresetStore().all()["roof"]
    assert [near(old.position_ecef_m) for old in preset.history] == [True]


def test_a_survey_after_a_loss_of_power_that_moves_the_base_is_told(receiver: SimulatedReceiver, make: Make):
    """Half a metre: within what surveys differ by, and yet every rover jumps by it."""
    base = make(mode="survey-in", minimum_s=5, accuracy_m=5.0)
    base.until_state("surveyed")
    base.until(lambda: (ref := base.reference()) and near(ref.position_ecef_m))
    receiver.power_cycle()
    receiver.bias_m = 0.5
    base.ask("restart")
    event = base.until_event("base_moved")
    assert (event.data["kind"], event.data["distance_m"]) == ("jump", pytest.approx(0.5, abs=1e-3))
    base.until(lambda: base.status().state is State.DEGRADED)
    assert base.ask("survey_start", minimum_s=5, accuracy_m=5.0).ok
    base.until(lambda: base.survey().state == "surveyed" and base.status().state is State.RUNNING)


def test_what_the_receiver_sends_is_watched(receiver: SimulatedReceiver, make: Make):
    """Another program tells the receiver another place, and then the old one again. We say nothing to it."""
    other = make(mode="fixed", position_ecef_m=PLACE)
    other.until_state("fixed")
    other.close()
    base = make(mode="watch")
    base.until(lambda: (ref := base.reference()) and near(ref.position_ecef_m))
    told = receiver.heard["ubx/06-8a"]
    with receiver._lock:
        before = dict(receiver.ram)
        receiver.ram[next(key for key, value in before.items() if value == 426898712)] += 300
    assert base.until_event("base_moved").data["distance_m"] == pytest.approx(3.0, abs=1e-3)
    with receiver._lock:
        receiver.ram.update(before)
    base.until_event("base_back")
    base.until(lambda: base.status().state is State.RUNNING)
    assert receiver.heard["ubx/06-8a"] == told
    assert base.codes().count("base_moved") == 1


def test_a_receiver_without_survey_is_averaged(receiver: SimulatedReceiver, make: Make):
    base = make(mode="average", receiver="other", minimum_s=2, accuracy_m=4.0, preset="mast")
    base.until(lambda: (seen := base.survey()).observations > 3 and seen.active)
    done = base.until_state("averaged")
    assert done.accuracy_m is not None
    assert 3.0 < done.accuracy_m <= 4.0, "a minute of code positions is no better than one"
    assert near(done.position_ecef_m, within_m=0.02)
    ref = base.reference()
    assert ref is not None
    assert (ref.origin, near(ref.position_ecef_m, within_m=0.02)) == ("average", True)
    assert PresetStore().get("mast") is not None
    assert receiver.heard.total() == 0, "it is told nothing"


def test_a_survey_can_be_ended(receiver: SimulatedReceiver, make: Make):
    base = make(mode="survey-in", minimum_s=4000, accuracy_m=0.01)
    base.until_state("surveying")
    assert base.ask("survey_stop").code is Code.ACCEPTED
    base.until(lambda: receiver.mode == 0)
    assert base.survey().state == "off"


TEXTS: dict[str, tuple[type[TextReceiver], list[str]]] = {
    "unicore": (SimulatedUnicore, ["MODE BASE TIME 1"]),
    "septentrio": (SimulatedMosaic, ["setPVTMode, Rover", "setPVTMode, Static, , auto"]),
}


@pytest.mark.parametrize("language", TEXTS)
def test_receivers_of_text_survey_and_are_told_positions(language: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """They say no progress: the survey is done when their time is over and their place comes."""
    monkeypatch.setenv(STATE_VARIABLE, str(tmp_path))
    kind, commands = TEXTS[language]
    with running(kind()) as receiver:
        base = Base(receiver.path, receiver=language, mode="survey-in", minimum_s=1, preset="roof")
        done = base.until_state("surveyed")
        assert receiver.heard == commands
        assert near(done.position_ecef_m)
        assert done.accuracy_m == 10.0, "nobody knows"
        assert PresetStore().get("roof") is not None
        assert base.ask("survey_stop").ok
        base.until(lambda: receiver.position is None)
        PresetStore().save(Found((PLACE[0], PLACE[1] + 9.0, PLACE[2]), 0.02, "operator").saved_as("mast", 0, "test", ReferenceStation(7)))
        assert base.ask("use_preset", name="mast", unchecked=True).ok
        base.until_state("fixed")
        base.until(lambda: near(receiver.position, (PLACE[0], PLACE[1] + 9.0, PLACE[2])))
        base.close()


def test_a_receiver_of_text_that_refuses_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(STATE_VARIABLE, str(tmp_path))
    with running(SimulatedUnicore(refused=("MODE BASE",))) as receiver:
        base = Base(receiver.path, receiver="unicore", mode="survey-in", minimum_s=1)
        text = base.until_event("base_failed").text
        base.close()
    assert text.startswith("MODE BASE TIME 1: refused (PARSING FAILED NO MATCHING FUNC MODE BASE TIME 1); trying again")


@pytest.mark.parametrize(
    ("op", "arguments", "code"),
    [
        ("use_preset", {"name": "nowhere"}, Code.NOT_FOUND),
        ("use_preset", {"name": "../etc"}, Code.BAD_ARGUMENTS),
        ("use_preset", {}, Code.BAD_ARGUMENTS),
        ("save_preset", {"name": "x" * 65}, Code.BAD_ARGUMENTS),
        ("survey_start", {"minimum_s": -1}, Code.BAD_ARGUMENTS),
        ("survey_start", {"accuracy_m": "nan"}, Code.BAD_ARGUMENTS),
        ("survey_start", {"accuracy_m": True}, Code.BAD_ARGUMENTS),
        ("survey_start", {"messages": "msm9"}, Code.BAD_ARGUMENTS),
        ("survey_start", {"messages": "msm4", "systems": "GX"}, Code.BAD_ARGUMENTS),
        ("fix_position", {}, Code.BAD_ARGUMENTS),
        ("fix_position", {"position_ecef_m": [1.0, 2.0, 3.0]}, Code.BAD_ARGUMENTS),
        ("fix_position", {"position_ecef_m": "here"}, Code.BAD_ARGUMENTS),
        ("fix_position", {"position_ecef_m": list(PLACE), "accuracy_m": 0}, Code.BAD_ARGUMENTS),
    ],
)
def test_wrong_arguments_are_refused(make: Make, op: str, arguments: dict[str, Any], code: Code):
    assert make(mode="watch").ask(op, **arguments).code is code


def test_a_base_without_a_position_has_nothing_to_save(make: Make):
    assert make(mode="watch").ask("save_preset", name="roof").code is Code.WRONG_STATE
    assert make(mode="watch").ask("presets").data == {"presets": []}


def test_a_receiver_that_loses_its_power_behind_an_adapter_is_told_again(receiver: SimulatedReceiver, make: Make):
    """The port stays open; the survey is gone, and NAV-SVIN (which is in its flash) says so."""
    receiver.flash[key("CFG_MSGOUT_UBX_NAV_SVIN_UART1")] = 1
    base = make(mode="survey-in", minimum_s=5, accuracy_m=5.0)
    base.until_state("surveyed")
    receiver.power_cycle()
    base.until_event("base_forgot")
    base.until(lambda: base.codes().count("survey_done") == 2)
    assert "base_moved" not in base.codes()
