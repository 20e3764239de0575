"""What an ingest tells of its sources: counts, rates, ages, strengths; what a hostile stream cannot do to it; what people see of it."""

from itertools import islice

import msgspec
import pytest
from rich.console import Console

from rtkmesh.codecs.messages import Frame, Protocol
from rtkmesh.codecs.rtcm3_encode import frame
from rtkmesh.codecs.stream import StreamDecoder, StreamOptions
from rtkmesh.codecs.ubx_encode import frame as ubx_frame
from rtkmesh.gnss.time import GpsTime
from rtkmesh.simulation.scenario import open_stream
from rtkmesh_schemas.status import InputStatus, ServiceStatus, State, StreamStatus
from rtkmesh_schemas.wire import MAXIMUM_BYTES, decode, encode
from rtkmesh_services.cli.receivers import receiver_table, source_details
from rtkmesh_services.ingest.figures import TOLD, SourceFigures
from rtkmesh_services.ingest.links import Chunk
from rtkmesh_services.ingest.live import counters_of

START, RATE_HZ = GpsTime(2400, 7200.0), 5.0
SECOND = 1_000_000_000


class Ingest:
    """A source whose clock the test moves."""

    def __init__(self, antenna: str = "base") -> None:
        self.decoder = StreamDecoder(StreamOptions(approximate_time=START))
        self.figures, self.now_ns = SourceFigures(), 5 * SECOND
        self.epochs = open_stream("demo", antenna, seed=3, rate_hz=RATE_HZ, start=START).epochs()

    def take(self, data: bytes) -> None:
        self.figures.chunk(Chunk(data, self.now_ns), self.decoder.feed(data))

    def status(self) -> StreamStatus:
        return self.figures.status(self.now_ns, self.decoder.framing, self.decoder.decoding)

    def play(self, epochs: int) -> None:
        for epoch in islice(self.epochs, epochs):
            self.take(epoch.data)
            self.status()
            self.now_ns += round(SECOND / RATE_HZ)


def test_a_stream_is_told_in_full():
    """Rates, ages and satellites are those that were sent."""
    ingest = Ingest()
    ingest.play(60)
    status = ingest.status()
    assert status.epochs == pytest.approx(60, abs=1)  # the last one is whole with the next
    assert status.epochs_per_s == pytest.approx(RATE_HZ, rel=0.05)
    assert status.frames["rtcm3/1077"].count == 60
    assert status.frames["rtcm3/1077"].per_s == pytest.approx(RATE_HZ, rel=0.05)
    assert status.frames["rtcm3/1077"].age_s == pytest.approx(0.2)
    assert 4 < status.satellites["G"] < 15
    assert {"G1C", "G2L", "E1C", "R1C", "C2I"} <= set(status.signals)
    assert 30.0 < status.cn0_dbhz["1"].minimum < status.cn0_dbhz["1"].mean < 55.0
    assert status.bytes_per_s == pytest.approx(5300, rel=0.5)
    assert (status.checksum_failures, status.refused) == ({}, {})


def test_the_antenna_is_told_with_its_origin_and_age_also_when_nothing_changes():
    """Stations repeat their position; a configured one stands over what the stream says."""
    ingest = Ingest()
    ingest.play(60)
    reference = ingest.status().reference
    assert reference is not None
    assert reference.origin == "rtcm3"
    assert reference.age_s is not None
    assert reference.age_s < 6.0
    known = SourceFigures((1.0, 2.0, 3.0)).status(0, ingest.decoder.framing, ingest.decoder.decoding).reference
    assert known is not None
    assert (known.position_ecef_m, known.origin, known.age_s) == ((1.0, 2.0, 3.0), "configuration", None)


def test_silence_is_seen_by_ages_and_rates():
    """Counts stay, ages grow, rates fall to nothing within the window."""
    ingest = Ingest()
    ingest.play(20)
    for _ in range(30):
        ingest.now_ns += SECOND
        ingest.status()
    status = ingest.status()
    assert (status.epochs_per_s, status.frames["rtcm3/1077"].per_s, status.bytes_per_s) == (0.0, 0.0, 0.0)
    assert status.epoch_age_s == pytest.approx(30.2, abs=0.3)
    assert status.frames["rtcm3/1077"].count == 20


def test_damage_and_refusals_are_told_by_protocol_and_reason():
    ingest = Ingest()
    broken = bytearray(frame(b"\x3e\xd0" + bytes(17)))
    broken[8] ^= 1
    ingest.take(bytes(broken) + frame(b"\x3e\xd0" + bytes(17)) + ubx_frame(0x02, 0x15, bytes(3)))
    status = ingest.status()
    assert status.checksum_failures == {"rtcm3": 1}
    assert status.refused == {"rtcm3/1005 not on earth": 1, "ubx/02-15 length": 1}


def test_the_status_of_a_hostile_stream_fits_into_a_message():
    """Each frame of another kind: what is told and what is kept is bounded; nothing of the sum is lost."""
    ingest = Ingest()
    for number in range(4000):
        ingest.take(ubx_frame(number >> 8, number & 255, b""))
    status = ingest.status()
    framing, decoding = ingest.decoder.framing, ingest.decoder.decoding
    source = InputStatus(name="tcp", state="connected", counters=counters_of(framing, decoding), stream=status)
    whole = ServiceStatus(id="rover", role="ingest", state=State.RUNNING, start_id="x", heartbeat=1, inputs=[source] * 4)
    assert len(encode(whole)) < MAXIMUM_BYTES // 2
    assert len(status.frames) <= TOLD + 1
    assert framing.frames.total() == 4000 == sum(source.counters.values()) - sum(decoding.rejected.values())
    assert max(len(framing.frames), len(decoding.ignored), len(ingest.figures._frames)) < 1200
    assert decode(ServiceStatus, encode(whole)) == whole


def test_a_frame_costs_a_dictionary_update():
    """No kind makes another object once it is known."""
    figures, one = SourceFigures(), Frame(Protocol.UBX, "02-15", b"")
    figures.frame(one, 1)
    [entry] = figures._frames.values()
    figures.frame(one, 2)
    assert figures._frames[Protocol.UBX, "02-15"] is entry
    assert entry == [2, 2]


@pytest.mark.parametrize("width", [60, 200])
def test_people_see_the_sources_of_receivers(width: int):
    ingest = Ingest()
    ingest.play(60)
    source = InputStatus(name="tcp", state="connected", detail="\x1b[31mhost", messages=300, bytes=9, age_s=0.1, stream=ingest.status())
    status = ServiceStatus(id="base", role="ingest", state=State.RUNNING, start_id="x", heartbeat=1, inputs=[source])
    console = Console(width=width, record=True, force_terminal=False)
    table = receiver_table({"base": (status, 0)}, 0, width)
    assert table is not None
    console.print(table)
    console.print(source_details(status))
    text = console.export_text()
    assert all(word in text for word in ("base", "connected", "4.9", "rtcm3/1077", "from rtcm3"))
    assert "\x1b" not in text
    assert all(len(line) <= width for line in text.splitlines())
    assert receiver_table({"base": (msgspec.structs.replace(status, inputs=[]), 0)}, 0) is None
