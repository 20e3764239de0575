"""Our caster and our server push: with our own client, RTKLIB's str2str, a scripted caster, and clients that mean harm."""

import base64
import queue
import socket
import struct
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from random import Random

import pytest
from tests.patience import PATIENCE_S, until
from tests.services.scripted_caster import ScriptedCaster

from rtkmesh.codecs.framing import Framer
from rtkmesh.codecs.rtcm3_encode import frame
from rtkmesh_schemas.config import Deployment, IngestTable, OutputTable
from rtkmesh_schemas.keys import RAW, REF, STATUS, Role
from rtkmesh_schemas.observation import ReferenceMessage
from rtkmesh_schemas.status import ServiceStatus, State
from rtkmesh_schemas.wire import decode
from rtkmesh_services.errors import SourceError
from rtkmesh_services.ingest.links import Chunk, Link, LinkReport
from rtkmesh_services.ingest.urls import parse_source
from rtkmesh_services.ntrip.address import CasterAddress
from rtkmesh_services.ntrip.caster import Caster
from rtkmesh_services.ntrip.connection import fetch_table
from rtkmesh_services.ntrip.frames import FrameQueue, StreamPicture
from rtkmesh_services.ntrip.protocol import AnswerReader
from rtkmesh_services.ntrip.source_table import MountPoint
from rtkmesh_services.output.outlets import PushOpener
from rtkmesh_services.output.sender import Sender
from rtkmesh_services.output.service import create
from rtkmesh_services.output.targets import check_output, parse_target
from rtkmesh_services.runtime.backoff import Backoff
from rtkmesh_services.runtime.clock import ManualClock
from rtkmesh_services.runtime.lifecycle import Lifecycle
from rtkmesh_services.runtime.memory_bus import MemoryBus, MemoryNetwork
from rtkmesh_services.runtime.service import Context

QUICK = Backoff(0.01, 0.05, refused_first_s=0.05, refused_last_s=0.05)


def rtcm(number: int, size: int = 60, mark: int = 0) -> bytes:
    """A frame of a message number."""
    return frame(bytes([number >> 4, (number & 15) << 4, mark]) + bytes(size))


STATION, FRAMES = rtcm(1005), [rtcm(1077, mark=mark) for mark in range(100)]


@pytest.fixture
def caster() -> Iterator[Caster]:
    rows = {"BASE": MountPoint("BASE", "roof", lat_deg=52.5, lon_deg=13.4), "OTHER": MountPoint("OTHER")}
    caster = Caster("127.0.0.1", 0, rows, {"rover": "pass:word"}, maximum_clients=3)
    caster.start()
    yield caster
    caster.close()


def ask(port: int, request: str) -> socket.socket:
    connection = socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S)
    connection.sendall(request.encode())
    return connection


def answer(port: int, request: str) -> bytes:
    """Everything that the caster says to a request until it closes."""
    with ask(port, request) as connection:
        parts: list[bytes] = []
        while data := connection.recv(65536):
            parts.append(data)
        return b"".join(parts)


AUTHORIZED = f"Authorization: Basic {base64.b64encode(b'rover:pass:word').decode()}\r\n"


@pytest.mark.parametrize("version", ["1", "2"])
def test_a_client_gets_the_station_at_once_and_then_every_frame(caster: Caster, version: str):
    caster.publish("BASE", STATION)
    until(lambda: caster._pictures["BASE"].details)
    items: queue.Queue[Chunk | LinkReport] = queue.Queue()
    link = Link(parse_source(f"ntrip://rover:pass:word@127.0.0.1:{caster.port}/BASE?version={version}"), items.put)
    link.start()
    try:
        data = b""
        while STATION not in data:
            item = items.get(timeout=PATIENCE_S)
            data += item.data if isinstance(item, Chunk) else b""
        for one in FRAMES:
            caster.publish("BASE", one)
            caster.publish("OTHER", rtcm(1087))
        while not data.endswith(FRAMES[-1]):
            item = items.get(timeout=PATIENCE_S)
            data += item.data if isinstance(item, Chunk) else b""
        assert data.removeprefix(b"\r\n") == STATION + b"".join(FRAMES)
        [client] = caster.clients()
        assert (client.mount, client.version, client.user, client.dropped) == ("BASE", int(version), "rover", 0)
        assert client.agent.startswith("NTRIP rtkmesh/")
    finally:
        link.stop()
    until(lambda: not caster.clients())


def test_the_table_tells_what_is_sent_and_where_from(caster: Caster):
    caster.publish("BASE", STATION)
    caster.publish("BASE", rtcm(1097))
    until(lambda: caster._pictures["BASE"].systems)
    for version in (1, 2):
        base, other = fetch_table(CasterAddress("127.0.0.1", caster.port), version=version)
        assert (base.name, base.identifier, base.format, base.details, base.systems) == (
            "BASE",
            "roof",
            "RTCM 3.3",
            "1005(1),1097(1)",
            "GAL",
        )
        assert (base.lat_deg, base.lon_deg, base.authentication, base.carrier) == (52.5, 13.4, "B", 2)
        assert other.name == "OTHER"


@pytest.mark.parametrize(
    ("request_text", "beginning"),
    [
        ("GET /BASE HTTP/1.0\r\nUser-Agent: NTRIP x\r\n\r\n", b"HTTP/1.0 401 Unauthorized\r\n"),
        (
            "GET /BASE HTTP/1.1\r\nNtrip-Version: Ntrip/2.0\r\nAuthorization: Basic cm92ZXI6d3Jvbmc=\r\n\r\n",
            b"HTTP/1.1 401 Unauthorized\r\n",
        ),
        ("GET /BASE HTTP/1.0\r\nAuthorization: Basic ///not base64\r\n\r\n", b"HTTP/1.0 401 "),
        ("GET /BASE HTTP/1.0\r\nAuthorization: Digest x\r\n\r\n", b"HTTP/1.0 401 "),
        ("GET /NONE HTTP/1.0\r\n\r\n", b"SOURCETABLE 200 OK\r\n"),
        ("GET /NONE HTTP/1.1\r\nNtrip-Version: Ntrip/2.0\r\n\r\n", b"HTTP/1.1 404 Not Found\r\n"),
        ("GET /../etc/passwd HTTP/1.1\r\nNtrip-Version: Ntrip/2.0\r\n\r\n", b"HTTP/1.1 404 Not Found\r\n"),
        ("SOURCE pass /BASE\r\nSource-Agent: NTRIP x\r\n\r\n", b"ERROR - "),
        ("POST /BASE HTTP/1.1\r\nNtrip-Version: Ntrip/2.0\r\n\r\n", b"HTTP/1.1 405 "),
        ("nonsense\r\n\r\n", b"HTTP/1.0 400 "),
        ("\r\n\r\n", b"HTTP/1.0 400 "),
        ("GET / HTTP/1.0\r\nX: " + "x" * 20000, b"HTTP/1.0 400 "),
    ],
)
def test_every_wrong_request_has_its_answer_and_an_end(caster: Caster, request_text: str, beginning: bytes):
    try:
        assert answer(caster.port, request_text).startswith(beginning)
    except ConnectionResetError:
        assert len(request_text) > 8192, "what was not read any more resets the connection"
    assert caster.clients() == []


def test_more_clients_than_allowed_are_asked_to_come_back(caster: Caster):
    request = f"GET /BASE HTTP/1.1\r\nNtrip-Version: Ntrip/2.0\r\n{AUTHORIZED}\r\n"
    served = [ask(caster.port, request) for _ in range(3)]
    until(lambda: len(caster.clients()) == 3)
    said = answer(caster.port, request)
    assert said.startswith(b"HTTP/1.1 503 ")
    assert b"\r\nRetry-After: 30\r\n" in said
    for connection in served:
        connection.close()
    until(lambda: not caster.clients())


def test_a_client_that_does_not_read_loses_whole_frames_and_nobody_waits(caster: Caster):
    """Oldest first, bounded, and what arrives is framed as before; another client gets everything."""
    slow = socket.socket()
    slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    slow.settimeout(PATIENCE_S)
    slow.connect(("127.0.0.1", caster.port))
    slow.sendall(f"GET /BASE HTTP/1.1\r\nNtrip-Version: Ntrip/2.0\r\n{AUTHORIZED}\r\n".encode())
    quick = ask(caster.port, f"GET /BASE HTTP/1.0\r\n{AUTHORIZED}\r\n")
    until(lambda: len(caster.clients()) == 2)
    sent, received = [rtcm(1077, 1000, mark % 256) for mark in range(1000)], b""
    for number, one in enumerate(sent):
        caster.publish("BASE", one)
        if number % 10 == 9:
            while received.count(one[:6]) < 1 or not received.endswith(one):
                received += quick.recv(65536)
            received = received[-2000:]
    dropped = max(client.dropped for client in caster.clients())
    assert dropped > 300
    reader, content = AnswerReader(), b""
    while sent[-1] not in content[-3000:]:
        content += reader.feed(slow.recv(65536))
    framer = Framer()
    frames = framer.feed(content)
    assert framer.counters.bytes_skipped == 0
    assert len(frames) == len(sent) - dropped
    for connection in (slow, quick):
        connection.close()


def test_half_open_connections_keep_nobody_out(caster: Caster):
    idle = [socket.create_connection(("127.0.0.1", caster.port)) for _ in range(30)]
    with ask(caster.port, f"GET /BASE HTTP/1.0\r\n{AUTHORIZED}\r\n") as client:
        assert client.recv(100) == b"ICY 200 OK\r\n\r\n"
    for connection in idle:
        connection.close()


def test_noise_from_hundreds_of_strangers_disturbs_nobody(caster: Caster):
    """Random bytes, half requests, resets: the thread lives, nothing is left, and a client is served."""
    random = Random(7)
    for number in range(300):
        with socket.create_connection(("127.0.0.1", caster.port), timeout=PATIENCE_S) as stranger:
            beginning = random.choice([b"", b"GET /BASE HTTP/1.1\r\nAuthorization: Basic ", b"POST / HTTP/1.1\r\n", b"\r\n"])
            with suppress(OSError):
                stranger.sendall(beginning + random.randbytes(random.randrange(600)) + random.choice([b"", b"\r\n\r\n"]))
            if number % 3 == 0:
                stranger.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        caster.publish("BASE", FRAMES[number % 100])
    with ask(caster.port, f"GET /BASE HTTP/1.0\r\n{AUTHORIZED}\r\n") as client:
        assert client.recv(100).startswith(b"ICY 200 OK\r\n")
        until(lambda: len(caster._clients) == 1)


@pytest.mark.rtklib
def test_str2str_as_client_gets_every_frame(caster: Caster, rtklib_program: Callable[[str], str], tmp_path: Path):
    log = tmp_path / "log.rtcm3"
    url = f"ntrip://rover:pass:word@127.0.0.1:{caster.port}/BASE"
    command = [rtklib_program("str2str"), "-in", url, "-out", f"file://{log}"]
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        until(caster.clients)
        for one in FRAMES:
            caster.publish("BASE", one)
        until(lambda: log.exists() and log.read_bytes().endswith(FRAMES[-1]))
    finally:
        process.terminate()
        process.wait()
    assert log.read_bytes().removeprefix(b"\r\n") == b"".join(FRAMES)


# --- feeding a caster


@pytest.mark.parametrize(
    ("url", "first", "chunks"), [("user:secret@", b"POST /MNT HTTP/1.1\r\n", True), (":secret@", b"SOURCE secret /MNT\r\n", False)]
)
def test_a_push_sends_every_frame_and_the_station_first_after_a_drop(url: str, first: bytes, chunks: bool):
    received: queue.Queue[bytes] = queue.Queue()
    again = threading.Event()

    def script(connection: socket.socket, number: int) -> None:
        assert number == 0 or again.wait(PATIENCE_S)
        connection.sendall(b"HTTP/1.1 200 OK\r\n\r\n" if chunks else b"ICY 200 OK\r\n")
        reader, data = AnswerReader(), b""
        reader.feed(b"HTTP/1.1 200 OK\r\n" + (b"Transfer-Encoding: chunked\r\n" if chunks else b"") + b"\r\n")
        while not data.endswith(FRAMES[5 * number + 4]):
            data += reader.feed(connection.recv(65536))
        received.put(data)

    caster = ScriptedCaster(script)
    push = Sender(PushOpener(parse_target(f"ntrip://{url}127.0.0.1:{caster.port}/MNT"), QUICK), StreamPicture())
    try:
        for one in (STATION, *FRAMES[:5]):
            push.send(one)
        assert received.get(timeout=PATIENCE_S) in (STATION + b"".join([STATION, *FRAMES[:5]]), b"".join([STATION, *FRAMES[:5]]))
        assert caster.request(0).startswith(first)
        until(lambda: push.state == "error")
        assert "closed by the caster" in push.detail
        again.set()
        until(lambda: len(caster.requests) == 2)
        for one in FRAMES[5:10]:
            push.send(one)
        assert received.get(timeout=PATIENCE_S) == STATION + b"".join(FRAMES[5:10])
    finally:
        push.close()
        caster.close()


@pytest.mark.parametrize(
    ("sent", "says"),
    [(b"ERROR - Bad Password\r\n", "Bad Password"), (b"HTTP/1.1 409 Conflict\r\n\r\n", "somebody else feeds this mount point")],
)
def test_a_caster_that_refuses_a_push_is_told_in_words(sent: bytes, says: str):
    caster = ScriptedCaster(lambda connection, _: connection.sendall(sent))
    push = Sender(PushOpener(parse_target(f"ntrip://u:secret@127.0.0.1:{caster.port}/MNT?version=1"), QUICK), StreamPicture())
    until(lambda: says in push.detail)
    assert "secret" not in push.detail
    push.close()
    caster.close()


def test_a_queue_is_bounded_in_bytes_and_age():
    queue_ = FrameQueue(1000, 5.0)
    for number in range(100):
        queue_.put(bytes([number]) * 100, 0.0)
    assert (queue_.bytes, queue_.dropped) == (1000, 90)
    queue_.put(b"new", 6.0)
    assert (queue_.get(), queue_.get(), queue_.bytes, queue_.dropped) == (b"new", None, 0, 100)


def test_the_picture_of_a_stream():
    picture = StreamPicture()
    for second in range(21):
        for number in [1077, 1087, *([1005] if second % 10 == 0 else [])]:
            picture.add(rtcm(number), float(second))
    assert (picture.format, picture.details, picture.systems) == ("RTCM 3.3", "1005(10),1077(1),1087(1)", "GPS+GLO")
    assert picture.bitrate == pytest.approx(8 * (42 + 3) * 69 / 20, rel=0.05)


# --- the output role


class World:
    """An output of frames on a bus of its own."""

    def __init__(self, table: OutputTable) -> None:
        network = MemoryNetwork()
        self.sender, self.bus, self.clock = MemoryBus("base", network), MemoryBus("out", network), ManualClock()
        deployment = Deployment(ingest={"base": IngestTable(source="udp://127.0.0.1:1")}, output={"out": table})
        context = Context(id="out", role=Role.OUTPUT, deployment=deployment, bus=self.bus, clock=self.clock)
        self.life = Lifecycle(create(context), warm_in_thread=False)
        self.life.start()
        self.life.step(0.0)

    def send(self, frames: list[bytes]) -> None:
        for one in frames:
            self.sender.publish(RAW, one, protocol="rtcm3")
        while self.life.context.inbox.depth():
            self.life.step(0.0)

    def status(self) -> ServiceStatus:
        self.clock.advance(1.1)
        self.life.step(0.0)
        return decode(ServiceStatus, self.bus.sent(STATUS)[-1].payload)


def test_frames_go_to_a_file_filtered(tmp_path: Path):
    world = World(OutputTable(receiver="base", target=f"file://{tmp_path}/log.rtcm3", messages=(1005, 1077)))
    world.send([STATION, rtcm(1087), FRAMES[0]])
    status = world.status()
    world.life.service.close()
    assert (tmp_path / "log.rtcm3").read_bytes() == STATION + FRAMES[0]
    assert (status.counters["frames"], status.counters["frames_left_out"]) == (3, 1)


def test_the_caster_of_a_deployment_says_where_its_bases_are(free_port: Callable[[], int]):
    port = free_port()
    table = OutputTable(target=f"ntrip-caster://127.0.0.1:{port}", mounts={"ROOF": "base"}, users={"rover": "pass:word"})
    world = World(table)
    place = ReferenceMessage(source="base", start_id="x", sequence=0, station_id=1, position_ecef_m=(3784992.7, 901280.7, 5037095.8))
    world.sender.publish(REF, place)
    world.send([STATION])
    with ask(port, f"GET /ROOF HTTP/1.0\r\n{AUTHORIZED}\r\n") as client:
        data = b""
        while STATION not in data:
            data += client.recv(4096)
        status = world.status()
        assert [row.name.split()[0] for row in status.inputs] == ["caster", "client"]
        assert "ROOF, version 1, rover" in status.inputs[1].detail
        [row] = fetch_table(CasterAddress("127.0.0.1", port))
        assert (row.name, row.identifier, row.lat_deg, row.lon_deg) == ("ROOF", "base", 52.5, 13.39)
    world.life.service.close()


def test_a_busy_port_is_said_and_waited_for(free_port: Callable[[], int]):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        world = World(OutputTable(target=f"ntrip-caster://127.0.0.1:{port}", mounts={"ROOF": "base"}))
        status = world.status()
        assert status.state is State.DEGRADED
        assert "in use" in status.reason
    world.status()
    assert world.status().state is State.RUNNING
    world.life.service.close()


@pytest.mark.parametrize(
    ("table", "says"),
    [
        (OutputTable(target="ntrip-caster://0.0.0.0:2101", mounts={"M": "base"}), "everybody could read"),
        (OutputTable(target="zenoh://", receiver="base"), "on the network already"),
        (OutputTable(target="ntrip://u:secret@host", receiver="base"), "no mount point"),
        (OutputTable(target="ntrip://u:secret@host/M?version=3", receiver="base"), "allowed are 1, 2"),
        (OutputTable(target="ntrip://u:secret@host/M?gga=on", receiver="base"), "unknown option 'gga'"),
        (OutputTable(target="ntrip://:two words@host/M", receiver="base"), "needs version=2"),
        (OutputTable(target="ntripp://u:secret@host/M", receiver="base"), "unknown target"),
        (OutputTable(target="tcp://u:secret@host", receiver="base"), "needs host:port"),
    ],
)
def test_wrong_targets_are_named_without_secrets(table: OutputTable, says: str):
    with pytest.raises(SourceError, match=says) as raised:
        check_output(table)
    assert "secret" not in str(raised.value)
