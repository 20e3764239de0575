"""What receivers tell of themselves, in the status of their ingest and as events."""

import gzip
from dataclasses import replace
from math import degrees, nan, radians
from pathlib import Path
from typing import Any

import pytest

from rtkmesh.codecs import nmea_encode, novatel_encode, sbf_encode
from rtkmesh.codecs.unicore_encode import encode_heading
from rtkmesh.gnss.ephemeris import ReferenceStation
from rtkmesh.gnss.receiver import (
    AntennaState,
    CarrierSolution,
    CommandAnswer,
    CorrectionUse,
    EventMark,
    Jamming,
    PortsHealth,
    PortUse,
    ReceiverHeading,
    ReceiverVersion,
    RfBlock,
    RfHealth,
    SatelliteInView,
    SatellitesInView,
    SurveyIn,
)
from rtkmesh.gnss.time import GpsTime
from rtkmesh_schemas.attitude import HeadingMessage
from rtkmesh_schemas.config import Deployment, IngestTable
from rtkmesh_schemas.keys import EVENT, STATUS, Role
from rtkmesh_schemas.keys import HEADING as HEADING_KEY
from rtkmesh_schemas.status import Event, Level, ServiceStatus
from rtkmesh_schemas.wire import decode, encode
from rtkmesh_services.ingest.links import Chunk
from rtkmesh_services.ingest.receiver_state import ReceiverState
from rtkmesh_services.ingest.service import IngestService
from rtkmesh_services.runtime.clock import ManualClock
from rtkmesh_services.runtime.lifecycle import Lifecycle
from rtkmesh_services.runtime.memory_bus import MemoryBus, MemoryNetwork
from rtkmesh_services.runtime.service import Context

TIME = GpsTime(2400, 100.0)
HEADING = ReceiverHeading(
    TIME, "UNIHEADING", CarrierSolution.FIXED, heading_rad=radians(123.5), length_m=1.25, satellites=20, station="999"
)


class Told:
    """What was told."""

    def __init__(self) -> None:
        self.events: list[tuple[Level, str, str, dict[str, Any]]] = []

    def __call__(self, level: Level, code: str, text: str, *, logged: bool = True, **data: Any) -> None:
        del logged
        self.events.append((level, code, text, data))


def test_headings_are_shown_and_none_is_none():
    """A receiver without a solution shows no heading, not zero."""
    state, told = ReceiverState(), Told()
    state.take(HEADING, 1_000_000_000, told)
    shown = state.data(1_500_000_000)["heading"]
    assert (shown["heading_deg"], shown["solution"], shown["valid"], shown["length_m"], shown["age_s"]) == (123.5, "FIXED", True, 1.25, 0.5)
    state.take(ReceiverHeading(TIME, "UNIHEADING", CarrierSolution.NONE), 2_000_000_000, told)
    shown = state.data(2_000_000_000)["heading"]
    assert (shown["heading_deg"], shown["valid"], shown["length_m"]) == (None, False, None)
    assert told.events == []


def test_reports_are_summed_up():
    """Survey, satellites, ports, version, corrections."""
    state, told = ReceiverState(), Told()
    state.take(
        SurveyIn(TIME, active=True, valid=False, duration_s=30, observations=31, position_ecef_m=(1.0, 2.0, 3.0), accuracy_m=2.5), 0, told
    )
    rows = (SatelliteInView(5, 40.0, 0.1, 0.2, 0.3, 7, used=True, healthy=True, corrected=False),
            SatelliteInView(6, nan, nan, nan, 0.0, 0, used=False, healthy=None, corrected=False))  # fmt: skip
    state.take(SatellitesInView(TIME, rows), 0, told)
    state.take(PortsHealth(memory_full=False, buffer_full=True, ports=(PortUse("uart1", 0, 9, 0.5, 0, 9, 0.25, 3, 0),)), 0, told)
    state.take(ReceiverVersion("ZED-F9P", "HPG 1.32", "00190000"), 0, told)
    for used, failed in ((True, False), (False, False), (None, True)):
        state.take(CorrectionUse(1077, 0, 12, failed, used), 0, told)
    data = state.data(0)
    assert (data["survey_in"]["active"], data["survey_in"]["accuracy_m"], data["survey_in"]["duration_s"]) == (True, 2.5, 30)
    assert data["satellites_in_view"] == {"known": 2, "received": 1, "used": 1, "age_s": 0.0}
    assert data["ports"]["uart1"] == {"overruns": 3, "sent_load": 0.5, "received_load": 0.25}
    assert data["ports"]["buffer_full"] is True
    assert data["receiver"]["model"] == "ZED-F9P"
    expected = {"messages": 3, "failed_crc": 1, "used": 1, "not_used": 1, "message": 1077, "station_id": 12, "age_s": 0.0}
    assert data["corrections_used"] == expected
    assert told.events == []


def test_faults_refusals_and_marks_are_events():
    """Each fault once when it comes, each mark with its times."""
    state, told = ReceiverState(), Told()

    def health(antenna: AntennaState, jamming: Jamming) -> RfHealth:
        return RfHealth("MON-RF", (RfBlock(0, antenna, True, jamming, 0.5, 0.25, 90),))

    for antenna, jamming in (("ok", "ok"), ("open", "ok"), ("open", "ok"), ("ok", "critical"), ("open", "ok")):
        state.take(health(AntennaState(antenna), Jamming(jamming)), 0, told)
    faults = [text for _, code, text, _ in told.events if code == "receiver_fault"]
    assert faults == ["antenna: no antenna", "interference, no position", "antenna: no antenna"]
    state.take(CommandAnswer("MODE NORTH", accepted=False, text="PARSING FAILED"), 0, told)
    state.take(CommandAnswer("MODE ROVER", accepted=True, text="OK"), 0, told)
    assert told.events[-1][:2] == (Level.WARNING, "command_refused")
    state.take(EventMark(0, TIME, None, 7, 2e-8), 0, told)
    level, code, text, data = told.events[-1]
    assert (level, code, data["rising"], data["falling"], data["count"]) == (Level.INFO, "event_mark", (2400, 100.0), None, 7)
    assert "100.000000000" in text
    found = state.data(0)
    assert (found["event_marks"], found["commands"]) == (1, {"refused": 1, "accepted": 1})
    assert found["radio"]["blocks"][0]["antenna"] == "open"


@pytest.fixture
def life() -> Lifecycle:
    """An ingest whose source the test is."""
    deployment = Deployment(ingest={"rover": IngestTable(source="tcp://127.0.0.1:1")})
    context = Context(id="rover", role=Role.INGEST, deployment=deployment, bus=MemoryBus("rover", MemoryNetwork()), clock=ManualClock())
    service = IngestService(context)
    assert service._live is not None
    service._live.start = lambda: None
    life = Lifecycle(service, warm_in_thread=False)
    life.start()
    life.step(0.0)
    return life


def feed(life: Lifecycle, data: bytes) -> ServiceStatus:
    """Let bytes come; return the status after them."""
    context = life.context
    for at in range(0, len(data), 60_000):
        context.inbox.put(Chunk(data[at : at + 60_000], context.clock.mono_ns()), lane="source")
        while context.inbox.depth():
            life.step(0.0)
    assert isinstance(context.clock, ManualClock)
    context.clock.advance(2.0)
    life.step(0.0)
    assert isinstance(context.bus, MemoryBus)
    status = decode(ServiceStatus, context.bus.sent(STATUS)[-1].payload)
    assert encode(status)
    return status


def test_the_ingest_shows_what_its_receiver_says(life: Lifecycle):
    """From bytes to the status on the bus."""
    status = feed(life, encode_heading(HEADING))
    assert status.data["heading"]["heading_deg"] == pytest.approx(123.5)
    assert status.data["heading"]["source"] == "UNIHEADING"


@pytest.mark.data
def test_event_marks_of_a_recording_are_events(life: Lifecycle, data: Path):
    """A walk with a M8P: marks at its event input, survey-in told as not active."""
    log = gzip.decompress((data / "galway_m8p" / "rover-20181004-1532.ubx.gz").read_bytes())[:400_000]
    status = feed(life, log)
    assert isinstance(life.context.bus, MemoryBus)
    events = [decode(Event, sample.payload) for sample in life.context.bus.sent(EVENT, level="info")]
    marks = [event for event in events if event.code == "event_mark"]
    assert len(marks) == status.data["event_marks"] > 20
    assert status.data["survey_in"]["active"] is False
    times = [event.data["rising"] or event.data["falling"] for event in marks]
    assert all(time[0] == 2021 for time in times if time)


def in_status(life: Lifecycle, data: bytes) -> dict[str, Any]:
    return feed(life, data).data


def nmea_bytes(*sentences: str) -> bytes:
    return "".join(sentences).encode()


OTHER_HEADINGS = {
    "AttEuler": sbf_encode.encode_attitude(replace(HEADING, roll_rad=nan, baseline_ned_m=None)),
    "HEADING2": novatel_encode.encode_heading(HEADING),
    "HEADING": novatel_encode.encode_heading(HEADING, "HEADING"),
    "HDT": nmea_bytes(nmea_encode.hdt(123.5)),
    "THS": nmea_bytes(nmea_encode.ths(123.5)),
}


@pytest.mark.parametrize("source", OTHER_HEADINGS)
def test_headings_of_every_kind_of_receiver_are_shown_alike(life: Lifecycle, source: str):
    """Septentrio, NovAtel and NMEA as u-blox and Unicore: the same names, and nothing where nothing is said."""
    heading = in_status(life, OTHER_HEADINGS[source])["heading"]
    assert heading["source"] == source
    assert heading["heading_deg"] == pytest.approx(123.5, abs=1e-3)
    assert heading["valid"] is True
    assert heading["solution"] == (None if source in ("HDT", "THS") else "FIXED")


@pytest.mark.parametrize("source", sorted(OTHER_HEADINGS))
def test_headings_of_every_kind_of_receiver_are_published(life: Lifecycle, source: str):
    """On a key of their own, for attitudes: numbered, with the message's name."""
    in_status(life, OTHER_HEADINGS[source])
    bus = life.context.bus
    assert isinstance(bus, MemoryBus)
    last = bus.sent(HEADING_KEY)[-1]
    heading = decode(HeadingMessage, last.payload, last.encoding)
    assert (heading.message, heading.valid, heading.sequence) == (source, True, len(bus.sent(HEADING_KEY)) - 1)
    assert degrees(heading.heading_rad) == pytest.approx(123.5, abs=1e-3)


def test_satellites_of_nmea_are_summed_up(life: Lifecycle):
    """GSV says what is seen, GSA before it what is used; the next cycle completes them."""
    rows = [
        nmea_encode.SatelliteInView(5, 30.0, 60.0, 40.0),
        nmea_encode.SatelliteInView(7, 31.0, 61.0, 41.0),
        nmea_encode.SatelliteInView(9, 5.0, 62.0),
    ]
    cycle = nmea_bytes(*nmea_encode.gsa((5, 7), 3, 1.5, 1.0, 1.1), *nmea_encode.gsv(rows))
    shown = in_status(life, cycle + cycle)["satellites_in_view"]
    assert (shown["known"], shown["received"], shown["used"]) == (3, 2, 2)


def test_what_a_septentrio_is_is_shown(life: Lifecycle):
    """ReceiverSetup says what MON-VER and VERSION say."""
    station = ReferenceStation(0, None, 0.1, "TRM57971.00     NONE", "1234", "SEPT MOSAIC-X5 4.14.0")
    shown = in_status(life, sbf_encode.encode_setup(station, TIME))["receiver"]
    assert (shown["model"], shown["software"]) == ("SEPT MOSAIC-X5", "4.14.0")
