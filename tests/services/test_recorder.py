"""Recording under bad circumstances: full disks, file limits, killed recorders; and what ``rtkmesh recover`` makes of what is left."""

import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.patience import PATIENCE_S

from rtkmesh.codecs.framing import Framer
from rtkmesh.codecs.rtcm3_encode import frame
from rtkmesh_schemas.config import Deployment, IngestTable, RecorderTable
from rtkmesh_schemas.keys import EVENT, RAW, Role
from rtkmesh_schemas.status import Event, ServiceStatus, State
from rtkmesh_schemas.wire import decode
from rtkmesh_services.cli.main import run
from rtkmesh_services.recorder.recovery import recover
from rtkmesh_services.recorder.service import RecorderService
from rtkmesh_services.runtime.clock import Clock
from rtkmesh_services.runtime.lifecycle import Lifecycle
from rtkmesh_services.runtime.memory_bus import MemoryBus, MemoryNetwork
from rtkmesh_services.runtime.raw_log import MAXIMUM_PENDING, RawLog
from rtkmesh_services.runtime.service import Context
from rtkmesh_services.runtime.time_tags import parse_tag, parse_times

IN_MEMORY = "/dev/shm" if Path("/dev/shm").is_dir() else None  # where fsync costs nothing
STARTED = datetime(2026, 11, 26, 9, 30, tzinfo=UTC)
FRAMES = [frame(bytes([0x3F, number & 255, *random.Random(number).randbytes(20 + number % 60)])) for number in range(400)]


def attachment(number: int, at_ns: int | None = None) -> bytes:
    """What an ingest says of a frame."""
    now_ns = time.monotonic_ns() if at_ns is None else at_ns
    return number.to_bytes(8, "little") + (1_700_000_000_000_000_000 + now_ns).to_bytes(8, "little") + now_ns.to_bytes(8, "little")


def content_of(folder: Path, pattern: str = "*.rtcm3") -> bytes:
    """All logs one behind the other, in the order in which they were begun."""
    begun = {path: path.stem.partition("Z") for path in folder.rglob(pattern)}
    logs = sorted(
        begun, key=lambda path: (begun[path][0], -int(begun[path][2] or 0))
    )  # the number behind the instant has a minus before it
    return b"".join(path.read_bytes() for path in logs)


class Recorder:
    """A recorder in this process, on an in-memory bus."""

    def __init__(self, folder: Path, **options: Any) -> None:
        network = MemoryNetwork()
        self.senders = {name: MemoryBus(name, network) for name in ("rover", "base")}
        self.bus = MemoryBus("logs", network)
        ingests = {name: IngestTable(source="udp://127.0.0.1:1") for name in self.senders}
        deployment = Deployment(ingest=ingests, recorder={"logs": RecorderTable(folder=str(folder), **options)})
        self.life = Lifecycle(
            RecorderService(Context(id="logs", role=Role.RECORDER, deployment=deployment, bus=self.bus, clock=Clock())),
            warm_in_thread=False,
        )
        self.life.start()
        self.life.step(0.0)
        self.number = 0

    def send(self, data: bytes, name: str = "base") -> None:
        self.senders[name].publish(RAW, data, attachment=attachment(self.number), protocol="rtcm3")
        self.number += 1
        self.life.step(0.0)

    def status(self) -> ServiceStatus:
        return self.life.status()

    def until(self, state: State) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while self.status().state is not state:
            assert time.monotonic() < deadline, self.status()
            self.life.step(0.05)

    def events(self, level: str) -> list[Event]:
        return [decode(Event, sample.payload, sample.encoding) for sample in self.bus.sent(EVENT, level=level)]


def test_without_a_list_all_receivers_are_recorded(tmp_path: Path):
    recorder = Recorder(tmp_path)
    for name in ("rover", "base"):
        recorder.send(FRAMES[0], name)
    recorder.life.finish()
    assert sorted(path.name.split("-")[0] for path in tmp_path.glob("*.rtcm3")) == ["base", "rover"]


def test_a_full_disk_stops_the_recording_between_frames_and_room_brings_it_back(small_disk: Path):
    """DEGRADED and an event, then RUNNING and an event; what came meanwhile waited in memory: nothing is lost or damaged."""
    ballast = small_disk / "ballast"
    ballast.write_bytes(bytes(200_000))
    recorder = Recorder(small_disk / "logs", tags=True)
    sent = [FRAMES[number % 400] for number in range(1600)]  # more than there is room for, less than the disk has without the ballast
    for data in sent:
        recorder.send(data)
    recorder.until(State.DEGRADED)
    assert "No space left" in recorder.status().reason
    [event] = [event for event in recorder.events("error") if event.code == "recording_failed"]
    assert "No space left" in event.text
    for _ in range(300):
        sent.append(FRAMES[len(sent) % 400])
        recorder.send(sent[-1])
    [on_disk] = (small_disk / "logs").glob("*.rtcm3")
    assert b"".join(sent).startswith(on_disk.read_bytes())
    ballast.unlink()
    recorder.until(State.RUNNING)
    sent.append(FRAMES[7])
    recorder.send(FRAMES[7])
    recorder.life.finish()
    assert "writing again; nothing was lost" in [event.text for event in recorder.events("info")]
    assert on_disk.read_bytes() == b"".join(sent)
    times = parse_times(Path(f"{on_disk}.times").read_bytes())
    tags = parse_tag(Path(f"{on_disk}.tag").read_bytes(), on_disk.stat().st_size)
    assert times is not None
    assert tags is not None
    assert list(times.offsets) == list(tags.offsets)
    assert len(times.offsets) == len(sent)
    assert recover(on_disk).faults == []


def test_a_disk_that_stays_full_leaves_whole_frames(small_disk: Path):
    """A recorder that ends with a full disk cuts what it could write a part of only."""
    (small_disk / "ballast").write_bytes(bytes(180_000))
    recorder = Recorder(small_disk / "logs")
    sent = [FRAMES[number % 400] for number in range(1800)]
    for data in sent:
        recorder.send(data)
    recorder.until(State.DEGRADED)
    recorder.life.finish()
    [log] = (small_disk / "logs").glob("*.rtcm3")
    data = log.read_bytes()
    assert b"".join(sent).startswith(data)
    framer = Framer()
    assert sum(len(frame.data) for frame in framer.feed(data)) == len(data) > 40_000
    assert framer.pending == 0


class Disk:
    """It hangs in fsync until it is released."""

    def __init__(self) -> None:
        self.hanging, self.released, self._fsync = threading.Event(), threading.Event(), os.fsync

    def fsync(self, descriptor: int) -> None:
        self.hanging.set()
        assert self.released.wait(PATIENCE_S)
        self._fsync(descriptor)


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    made = Disk()
    monkeypatch.setattr("rtkmesh_services.runtime.raw_log.os.fsync", made.fsync)
    return made


def test_a_disk_that_hangs_in_fsync_blocks_nobody(tmp_path: Path, disk: Disk):
    """The work loop takes frames while the writer waits for the disk; afterwards all of them are there."""
    recorder = Recorder(tmp_path)
    recorder.send(FRAMES[0])
    assert disk.hanging.wait(PATIENCE_S)
    for data in FRAMES[1:]:
        recorder.send(data)
    assert recorder.status().inputs[0].messages == len(FRAMES)
    assert recorder.status().data["waiting_bytes"] == sum(map(len, FRAMES[1:]))
    disk.released.set()
    recorder.life.finish()
    assert content_of(tmp_path) == b"".join(FRAMES)


def test_an_end_while_the_disk_hangs_in_fsync_loses_nothing(tmp_path: Path, disk: Disk, monkeypatch: pytest.MonkeyPatch):
    """What came meanwhile is written by who ends the process: the system has it, whenever the disk takes it."""
    monkeypatch.setattr("rtkmesh_services.recorder.service.CLOSE_S", 0.2)
    recorder = Recorder(tmp_path, tags=True)
    recorder.send(FRAMES[0])
    assert disk.hanging.wait(PATIENCE_S)
    for data in FRAMES[1:]:
        recorder.send(data)
    recorder.life.finish()
    assert content_of(tmp_path) == b"".join(FRAMES)
    disk.released.set()
    recorder.life.service._writer._thread.join(PATIENCE_S)
    [log] = tmp_path.glob("*.rtcm3")
    assert recover(log).faults == []


def test_what_waits_for_a_disk_is_bounded_and_then_frames_are_lost_whole(tmp_path: Path):
    log = RawLog.create(tmp_path, "base", "rtcm3", STARTED)
    taken = 0
    while log.append(FRAMES[taken % 400], None):
        taken += 1
    assert MAXIMUM_PENDING - 100 < log.pending <= MAXIMUM_PENDING
    log.write_out()
    assert log.append(FRAMES[0], None)
    assert log.finish() == []
    log.close()
    assert log.path.stat().st_size == sum(len(FRAMES[number % 400]) for number in range(taken)) + len(FRAMES[0])


LIMITED = """
import pathlib, resource, sys
sys.path.insert(0, {root!r})
from rtkmesh_services.runtime.kernel_cache import use_kernel_cache
use_kernel_cache()
from rtkmesh_services.recorder import service
service.CLOSE_S = 60.0
from tests.services.test_recorder import FRAMES, Recorder, content_of
resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000))
recorder = Recorder(pathlib.Path(sys.argv[1]), tags=True)
for number in range(1200):
    recorder.send(FRAMES[number % 400])
    if number % 300 == 299:
        recorder.life.step(0.3)
while len(content_of(pathlib.Path(sys.argv[1]))) < sum(len(FRAMES[number % 400]) for number in range(1200)):
    recorder.life.step(0.1)
recorder.life.finish()
"""


def test_a_log_that_may_not_grow_goes_on_in_another_file(tmp_path: Path):
    """A limit of file sizes (ulimit -f): whole frames in each file, none lost."""
    root = str(Path(__file__).resolve().parents[2])
    subprocess.run([sys.executable, "-c", LIMITED.format(root=root), str(tmp_path)], check=True, timeout=120)
    logs = list(tmp_path.glob("*.rtcm3"))
    assert len(logs) > 2
    assert all(log.stat().st_size <= 20000 and recover(log).faults == [] for log in logs)
    assert content_of(tmp_path) == b"".join(FRAMES[number % 400] for number in range(1200))


@pytest.mark.e2e
def test_a_killed_recorder_loses_less_than_a_second(fleet: Any):
    """A real process, killed while frames come: all that was sent a second before the kill is in the file, in order."""
    folder = fleet.folder / "logs"
    site = fleet.config
    site.write_text(f'{site.read_text()}[ingest.rover]\nsource = "udp://127.0.0.1:1"\n[recorder.logs]\nfolder = "{folder}"\n')
    fleet.hub()
    process = fleet.rtkmesh("run", "recorder", "--id", "logs", "--config", str(site))
    with fleet.bus("rover") as bus:
        fleet.is_running(bus, "logs")
        fleet.until(lambda: bus.matched(RAW, protocol="rtcm3"))
        sent: list[tuple[float, bytes]] = []
        deadline = time.monotonic() + 3.0
        while time.monotonic() < deadline:
            data = FRAMES[len(sent) % 400]
            bus.publish(RAW, data, attachment=attachment(len(sent)), protocol="rtcm3")
            sent.append((time.monotonic(), data))
            time.sleep(0.005)  # the rate of the frames, not a wait for anything
        process.kill()
        process.wait()
        killed_s = time.monotonic()
    [log] = folder.glob("*.rtcm3")
    whole = b"".join(data for _, data in sent)
    kept = log.read_bytes()
    assert whole.startswith(kept)
    stood_s = max(later_s - at_s for at_s, later_s in pairwise([*(at_s for at_s, _ in sent), killed_s]))  # in which nobody could write
    assert len(kept) >= sum(len(data) for at_s, data in sent if at_s < killed_s - 1.0 - stood_s)
    finding = recover(log)
    assert finding.error == ""
    assert finding.cut_bytes < 100


def recording(folder: Path, *, tags: bool = True) -> Path:
    """A log of all frames with its times, as a recorder leaves it."""
    log = RawLog.create(folder, "base", "rtcm3", STARTED, tags=tags)
    for number, data in enumerate(FRAMES[:60]):
        assert log.append(data, attachment(number, 10**9 + number * 200_000_000))
    assert log.finish() == []
    log.close()
    return log.path


def test_a_whole_log_gets_no_copy(tmp_path: Path):
    path = recording(tmp_path)
    finding = recover(path)
    assert (finding.frames, finding.faults, finding.written, finding.error) == (60, [], [], "")
    assert len(list(tmp_path.iterdir())) == 3


@given(cuts=st.tuples(st.floats(0, 1), st.floats(0, 1), st.floats(0, 1)), zeros=st.sampled_from([0, 0, 37, 4096]))
@settings(max_examples=40)
def test_any_cut_is_recovered_to_whole_frames_with_times(cuts: tuple[float, ...], zeros: int):
    """Data, .times and .tag cut anywhere, also filled with zeros: the longest whole beginning, a time for each frame."""
    folder = Path(tempfile.mkdtemp(dir=IN_MEMORY))
    try:
        recovered_as_cut(recording(folder), cuts, zeros)
    finally:
        shutil.rmtree(folder)


def recovered_as_cut(path: Path, cuts: tuple[float, ...], zeros: int) -> None:
    files = [path, Path(f"{path}.times"), Path(f"{path}.tag")]
    for file, share in zip(files, cuts, strict=True):
        os.truncate(file, round(file.stat().st_size * share))
    with path.open("ab") as file:
        file.write(bytes(zeros))
    before = {file: file.read_bytes() for file in files}
    finding = recover(path)
    assert finding.error == ""
    assert {file: file.read_bytes() for file in files} == before
    expected, size = b"", round(sum(map(len, FRAMES[:60])) * cuts[0])
    for data in FRAMES[:60]:
        if len(expected) + len(data) > size:
            break
        expected += data
    new = finding.written[0] if finding.written else path
    assert new.read_bytes() == expected
    times = parse_times(Path(f"{new}.times").read_bytes())
    if expected:
        assert times is not None
        assert times.offsets[-1] == len(expected)
        assert len(times.offsets) == finding.frames
        tags = parse_tag(Path(f"{new}.tag").read_bytes(), len(expected))
        assert tags is not None
        assert list(tags.offsets) == list(times.offsets)
    again = recover(path)
    assert (again.error, again.faults, again.before) == ("", finding.faults, bool(finding.written))


def test_the_command_reports_and_leaves_the_originals(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """A folder of a whole log and one that was cut; once more changes nothing; a log that cannot be written is an error."""
    whole, cut = recording(tmp_path / "a"), recording(tmp_path / "b")
    os.truncate(cut, cut.stat().st_size - 5)
    assert run(["recover", str(tmp_path)]) == 0
    text = capsys.readouterr().out
    assert "whole" in text
    assert "recovered" in text
    assert "no whole frame" in text
    assert run(["recover", str(tmp_path), "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [(row["path"], row["before"]) for row in rows] == [(str(whole), False), (str(cut), True)]
    assert run(["recover", str(tmp_path / "none")]) == 2


def test_recovery_without_room_leaves_nothing_behind(small_disk: Path):
    path = recording(small_disk)
    os.truncate(path, path.stat().st_size - 5)
    (small_disk / "ballast").write_bytes(bytes(os.statvfs(small_disk).f_bavail * 4096 - 4096))
    finding = recover(path)
    assert "No space left" in finding.error
    assert finding.written == []
    assert not list(small_disk.glob("*recovered*"))
