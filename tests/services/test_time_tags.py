"""Recordings with the instants of arrival: ours and RTKLIB's, in both directions, played as they came; files that are swapped."""

import itertools
import socket
import struct
import subprocess
import threading
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.patience import PATIENCE_S

from rtkmesh.codecs.messages import Frame
from rtkmesh.codecs.rtcm3_encode import frame
from rtkmesh.gnss.time import GpsTime
from rtkmesh_schemas.config import Deployment, IngestTable, RecorderTable
from rtkmesh_schemas.keys import RAW, Role
from rtkmesh_services.errors import SourceError
from rtkmesh_services.ingest.credit import CreditGate
from rtkmesh_services.ingest.recording import TimedRecording, open_recording
from rtkmesh_services.ingest.replay import Ended, Pace, Played, Replay
from rtkmesh_services.ingest.urls import parse_source
from rtkmesh_services.output.files import FileSink
from rtkmesh_services.output.sender import Header
from rtkmesh_services.output.targets import parse_target
from rtkmesh_services.recorder.service import RecorderService
from rtkmesh_services.runtime.clock import ManualClock
from rtkmesh_services.runtime.lifecycle import Lifecycle
from rtkmesh_services.runtime.memory_bus import MemoryBus, MemoryNetwork
from rtkmesh_services.runtime.path_keywords import expanded, swap_number
from rtkmesh_services.runtime.service import Context
from rtkmesh_services.runtime.time_tags import TagWriter, parse_tag, parse_times

FRAMES = [frame(bytes([0xFF, 0xE0 | number, *range(40 + number)])) for number in range(10)]
UTC_NS = int(datetime(2026, 11, 26, 9, 30, 0, 250000, tzinfo=UTC).timestamp() * 1e6) * 1000
ATTACHMENT = struct.Struct("<QqQ")


class Recorder:
    """A recorder on a bus of its own whose clock the test moves."""

    def __init__(self, folder: Path, **options: object) -> None:
        network = MemoryNetwork()
        self.clock = ManualClock(utc_ns=UTC_NS)
        self.sender, bus = MemoryBus("base", network), MemoryBus("logs", network)
        table = RecorderTable(folder=str(folder), receivers=("base",), **options)  # type: ignore[arg-type]
        deployment = Deployment(ingest={"base": IngestTable(source="udp://127.0.0.1:1")}, recorder={"logs": table})
        context = Context(id="logs", role=Role.RECORDER, deployment=deployment, bus=bus, clock=self.clock)
        self.life = Lifecycle(RecorderService(context), warm_in_thread=False)
        self.life.start()
        self.life.step(0.0)

    def record(self, frames: list[bytes], apart_s: float) -> None:
        for number, one in enumerate(frames):
            attachment = ATTACHMENT.pack(number, self.clock.utc_ns(), self.clock.mono_ns())
            self.sender.publish(RAW, one, attachment=attachment, protocol="rtcm3")
            self.life.step(0.0)
            self.clock.advance(apart_s)

    def close(self) -> None:
        self.life.service.close()


@pytest.mark.parametrize("tags", [False, True])
def test_what_was_recorded_is_played_as_it_came(tmp_path: Path, tags: bool) -> None:
    """Each frame leaves at its instant (to RTKLIB's millisecond), by the clock of the host that recorded."""
    recorder = Recorder(tmp_path, tags=tags)
    recorder.record(FRAMES, 0.4)
    recorder.close()
    [log] = tmp_path.glob("*.rtcm3")
    if tags:
        log.with_name(log.name + ".times").unlink()
    recording = open_recording(log, timed=True)
    assert isinstance(recording, TimedRecording)
    start = GpsTime.from_utc(datetime.fromtimestamp(UTC_NS * 1e-9, UTC))
    begin = open_recording(log, timed=True).begin()
    assert begin is not None
    assert abs(begin - start) < 2e-3
    parts = list(recording.timed_parts())
    assert [part[1].data for part in parts if part[1] is not None] == FRAMES
    assert [part[0] - start for part in parts[:10]] == pytest.approx([0.4 * number for number in range(10)], abs=2e-3)  # type: ignore[operator]


def test_a_replay_keeps_the_pace_of_the_arrival(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path)
    recorder.record(FRAMES, 0.5)
    recorder.close()
    [log] = tmp_path.glob("*.rtcm3")
    recording, played, clock = open_recording(log, timed=True), list[tuple[float, object]](), ManualClock()

    class Passing(threading.Event):
        """Time that passes while one waits."""

        def wait(self, timeout: float | None = None) -> bool:
            clock.advance(timeout or 0.0)
            return False

    def put(item: object) -> bool:
        played.append((clock.mono_ns() * 1e-9, item))
        return True

    Replay(recording, Pace(clock, 10.0, open_recording(log, timed=True).begin()), CreditGate([]), clock, put, 0).run(Passing())
    frames = [(at_s, item.item) for at_s, item in played if isinstance(item, Played) and isinstance(item.item, Frame)]
    assert [one.data for _, one in frames] == FRAMES
    assert isinstance(played[-1][1], Ended)
    apart_s = [b[0] - a[0] for a, b in itertools.pairwise(frames)]
    assert apart_s == pytest.approx([0.05] * 9, abs=1e-3)


@pytest.mark.rtklib
def test_str2strs_tags_are_read(rtklib_program: Callable[[str], str], tmp_path: Path) -> None:
    log = tmp_path / "log.rtcm3"
    with socket.create_server(("127.0.0.1", 0)) as feeder:
        feeder.settimeout(PATIENCE_S)
        source = f"tcpcli://127.0.0.1:{feeder.getsockname()[1]}"
        command = [rtklib_program("str2str"), "-in", source, "-out", f"file://{log}::T"]
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        connection, _ = feeder.accept()
        begun = GpsTime.from_utc(datetime.now(UTC))
        for number, one in enumerate(FRAMES):
            connection.sendall(one)
            wait_for_size(log, sum(map(len, FRAMES[: number + 1])))
        process.terminate()
        process.wait()
        connection.close()
    recording = open_recording(log, timed=True)
    parts = [(at, one) for at, one, _ in recording.timed_parts() if one is not None]
    assert [one.data for _, one in parts] == FRAMES
    instants = [at - begun for at, _ in parts]  # type: ignore[operator]
    assert instants == sorted(instants)
    assert -1.0 < instants[0] < instants[-1] < 20.0


def wait_for_size(path: Path, size: int) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not path.exists() or path.stat().st_size < size:
        assert time.monotonic() < deadline_s
        time.sleep(0.005)  # the other program writes when it likes


@pytest.mark.rtklib
def test_our_tags_are_read_by_str2str(rtklib_program: Callable[[str], str], tmp_path: Path) -> None:
    """RTKLIB plays our log at ten times its pace: all of it, in about a tenth of the time."""
    recorder = Recorder(tmp_path, tags=True)
    recorder.record(FRAMES, 2.0)
    recorder.close()
    [log] = tmp_path.glob("*.rtcm3")
    copy = tmp_path / "copy"
    begun_s = time.monotonic()
    command = [rtklib_program("str2str"), "-in", f"file://{log}::T::x10", "-out", f"file://{copy}"]
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    wait_for_size(copy, len(b"".join(FRAMES)))
    took_s = time.monotonic() - begun_s
    process.kill()
    process.wait()
    assert copy.read_bytes() == b"".join(FRAMES)
    assert 1.5 < took_s < 12.0, "not at its own pace, which takes 18 s"


def test_large_offsets_are_recognized() -> None:
    writer = TagWriter(UTC_NS, 5_000_000_000, large=True)
    data = writer.header + b"".join(writer.record(5_000_000_000 + 1_000_000 * number, 10 * number) for number in range(1, 20))
    tags = parse_tag(data + b"\0\0\0", 190)
    assert tags is not None
    assert (list(tags.offsets), tags.instants_s[0]) == ([10 * number for number in range(1, 20)], 0.001)
    assert abs(tags.start - GpsTime.from_utc(datetime.fromtimestamp(UTC_NS * 1e-9, UTC))) < 1e-6


@given(st.binary(max_size=400))
def test_any_bytes_are_tags_or_none(data: bytes) -> None:
    parse_tag(b"TIMETAG RTKLIB" + data, 1 << 30)
    parse_tag(data, 0)
    parse_times(data)


def test_what_is_missing_is_said(tmp_path: Path) -> None:
    log = tmp_path / "log.rtcm3"
    log.write_bytes(b"".join(FRAMES))
    with pytest.raises(SourceError, match=r"there is neither log\.rtcm3\.tag nor log\.rtcm3\.times"):
        open_recording(log, timed=True)
    (tmp_path / "log.rtcm3.tag").write_bytes(b"TIMETAG RTKLIB")
    with pytest.raises(SourceError, match="holds no times of this log"):
        open_recording(log, timed=True)


def test_rtklibs_way_to_write_paths() -> None:
    url = parse_source("file:///logs/a.ubx::T::+30::x10")
    assert (url.path, url.options) == ("/logs/a.ubx", {"times": "yes", "start": "30", "speed": "10"})
    target = parse_target("file:///logs/%Y.pos::S=6")
    assert (target.path, target.swap_hours) == ("/logs/%Y.pos", 6.0)
    assert parse_target("file:///logs/a.pos?swap=0.5").swap_hours == 0.5
    assert (parse_target("file:///logs/a.pos::T").tags, parse_target("file:///logs/a.pos").tags) == (True, False)
    with pytest.raises(SourceError, match="means nothing here"):
        parse_source("file:///logs/a.ubx::S=1")
    for wrong in ("file://x?swap=often", "file://x::X", "file://::S=1", "file://x?tags=maybe", "file://x?margin=-1"):
        with pytest.raises(SourceError):
            parse_target(wrong)


def test_keywords_are_in_gps_time() -> None:
    """18 s before midnight UTC the GPS day has begun; an hour's letter, the blocks of hours and of minutes."""
    utc_ns = int(datetime(2026, 11, 25, 23, 59, 43, tzinfo=UTC).timestamp()) * 1_000_000_000
    assert expanded("%Y-%m-%d %n %W %D %h%M%S", utc_ns) == "2026-11-26 330 2446 4 000001"
    assert expanded("/a/%y%%/%H_%ha_%hb_%hc_%t_%q", UTC_NS) == "/a/26%%/j_09_06_00_30_%q"


def test_files_are_swapped_at_whole_hours_and_never_overwritten(tmp_path: Path) -> None:
    clock, url = ManualClock(utc_ns=UTC_NS), parse_target(f"file://{tmp_path}/%h.pos?swap=1")
    sink = FileSink(url, Header(b"header\n"), clock)
    sink.send(b"one\n")
    clock.advance(29 * 60.0)
    sink.send(b"two\n")
    clock.advance(2 * 60.0)
    sink.send(b"three\n")
    assert sink.close() == ""
    again = FileSink(url, Header(b"header\n"), clock)
    again.send(b"four\n")
    assert again.close() == ""
    texts = {path.name: path.read_text() for path in tmp_path.iterdir()}
    assert texts == {"09.pos": "header\none\ntwo\n", "10.pos": "header\nthree\n", "10-1.pos": "header\nfour\n"}
    assert swap_number(UTC_NS, 0.0) == swap_number(clock.utc_ns(), 0.0) == 0


def test_a_recorder_swaps_its_logs(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "%Y%m%d", swap_hours=1.0, tags=True)
    recorder.record(FRAMES, 900.0)
    recorder.close()
    logs = sorted((tmp_path / "20261126").glob("*.rtcm3"))
    assert len(logs) == 3
    assert b"".join(log.read_bytes() for log in logs) == b"".join(FRAMES)
    assert all(open_recording(log, timed=True).begin() is not None for log in logs)
