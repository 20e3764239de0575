"""A caster's mount point as a source, against a scripted caster and RTKLIB's str2str: every byte of every kind of answer, every
fault in words, and never faster than a caster can bear."""

import queue
import socket
import ssl
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from tests.patience import PATIENCE_S
from tests.services.scripted_caster import Script, ScriptedCaster, chunked

from rtkmesh.codecs.rtcm3_encode import frame
from rtkmesh_services.control.endpoints import free_port
from rtkmesh_services.errors import RefusedError, SourceError
from rtkmesh_services.ingest.links import Chunk, Link, LinkReport, LinkState
from rtkmesh_services.ingest.ntrip_source import FindPlace
from rtkmesh_services.ingest.urls import parse_source
from rtkmesh_services.ntrip.address import CasterAddress
from rtkmesh_services.ntrip.connection import fetch_table
from rtkmesh_services.ntrip.place import Place
from rtkmesh_services.runtime.backoff import CASTER, LOCAL, Backoff, Pauses

FRAMES = [frame(bytes([0xFF, 0xE0 | number]) + bytes(range(40 + number))) for number in range(8)]
ALL = b"".join(FRAMES)
V2 = b"HTTP/1.1 200 OK\r\nNtrip-Version: Ntrip/2.0\r\nContent-Type: gnss/data\r\n"
CHUNKED = V2 + b"Transfer-Encoding: chunked\r\n\r\n"
QUICK = Backoff(0.01, 0.05, refused_first_s=0.5, refused_last_s=0.5)
TABLE = (
    b"SOURCETABLE 200 OK\r\nContent-Type: text/plain\r\n\r\n"
    b"STR;BASE1;A;RTCM 3.2;;2;GPS;X;DEU;52.50;13.40;0;0;x;none;B;N;4800;\r\n"
    b"STR;BASE2;B;RTCM 3.2;;2;GPS;X;DEU;52.00;13.40;0;0;x;none;B;N;4800;\r\n"
    b"STR;VRS;C;RTCM 3.2;;2;GPS;X;DEU;52.00;13.40;1;1;x;none;B;N;4800;\r\nENDSOURCETABLE\r\n"
)


class Sink:
    """What a link hands over."""

    def __init__(self) -> None:
        self.items: queue.Queue[Chunk | LinkReport] = queue.Queue()
        self.data = b""
        self.reports: list[LinkReport] = []

    def take(self, timeout_s: float = PATIENCE_S) -> Chunk | LinkReport:
        item = self.items.get(timeout=timeout_s)
        if isinstance(item, Chunk):
            self.data += item.data
        else:
            self.reports.append(item)
        return item

    def until_data(self, expected: bytes) -> None:
        while self.data != expected:
            self.take()
            assert expected.startswith(self.data)

    def until_state(self, state: LinkState, containing: str = "") -> LinkReport:
        while True:
            item = self.take()
            if isinstance(item, LinkReport) and item.state is state and containing in item.detail:
                return item

    def quiet_for(self, seconds: float) -> None:
        """Nothing more comes, after what is on its way."""
        deadline_s = time.monotonic() + seconds
        with suppress(queue.Empty):
            while (left_s := deadline_s - time.monotonic()) > 0.0:
                item = self.take(left_s)
                assert isinstance(item, LinkReport), "no data"


class World:
    """Casters and links of one test."""

    def __init__(self) -> None:
        self.links: list[Link] = []
        self.casters: list[ScriptedCaster] = []

    def caster(self, script: Script, *, tls: ssl.SSLContext | None = None) -> ScriptedCaster:
        self.casters.append(ScriptedCaster(script, tls=tls))
        return self.casters[-1]

    def link(self, url: str, *, find_place: FindPlace | None = None, backoff: Backoff = QUICK) -> Sink:
        sink = Sink()
        self.links.append(Link(parse_source(url), sink.items.put, find_place=find_place, backoff=backoff))
        self.links[-1].start()
        return sink

    def source(self, script: Script, options: str = "", mount: str = "BASE1", user: str = "") -> tuple[ScriptedCaster, Sink]:
        caster = self.caster(script)
        return caster, self.link(f"ntrip://{user}127.0.0.1:{caster.port}/{mount}{options}")


@pytest.fixture
def world() -> Iterator[World]:
    world = World()
    yield world
    for link in world.links:
        link.stop()
    for caster in world.casters:
        caster.close()


def sends(*pieces: bytes, stay: bool = True) -> Script:
    """A script that sends pieces and keeps the connection."""

    def script(connection: socket.socket, number: int) -> None:
        for piece in pieces:
            connection.sendall(piece)
        if stay:
            connection.recv(1)

    return script


STREAMS: dict[str, tuple[bytes, ...]] = {
    "v1": (b"ICY 200 OK\r\n", *FRAMES),
    "v1 in one piece": (b"ICY 200 OK\r\n" + ALL,),
    "v1 blank line": (b"ICY 200 OK\r\n\r\n" + FRAMES[0], *FRAMES[1:]),
    "v1 with header": (b"ICY 200 OK\r\nServer: x\r\n\r\n", *FRAMES),
    "v2": (V2 + b"\r\n" + FRAMES[0], *FRAMES[1:]),
    "v2 chunked": (CHUNKED + chunked(FRAMES[:1]), *(chunked([one]) for one in FRAMES[1:])),
    "v2 frames split over chunks": (CHUNKED, *(chunked([ALL[at : at + 33]]) for at in range(0, len(ALL), 33))),
    "v2 chunk extensions": (CHUNKED, *(chunked([one], b';ieof=1;x="y"') for one in FRAMES)),
    "v2 chunked byte by byte": (CHUNKED, *(bytes([byte]) for byte in chunked(FRAMES))),
    "v2 without content type": (b"HTTP/1.1 200 OK\r\n\r\n", *FRAMES),
}


@pytest.mark.parametrize("pieces", STREAMS.values(), ids=STREAMS)
def test_every_frame_of_every_kind_of_stream_arrives(world: World, pieces: tuple[bytes, ...]):
    _, sink = world.source(sends(*pieces))
    sink.until_data(ALL)


def test_thirty_drops_cost_no_frame_and_the_first_pause_comes_back(world: World):
    """Each connection brings one frame and ends, in turn by closing, by half-closing, by the last chunk and by a reset."""

    def script(connection: socket.socket, number: int) -> None:
        connection.sendall(CHUNKED + chunked([FRAMES[number % 8]]))
        if number % 4 == 1:
            connection.shutdown(socket.SHUT_WR)
            connection.recv(1)
        elif number % 4 == 2:
            connection.sendall(b"0\r\n\r\n")
            connection.recv(1)

    caster, sink = world.source(script)
    sink.until_data(b"".join(FRAMES[number % 8] for number in range(30)))
    assert len(caster.requests) >= 30
    closed = [report for report in sink.reports if report.state is LinkState.ERROR]
    assert all("closed by the other side" in report.detail and report.retry_s <= 0.01 for report in closed)


REFUSALS: dict[str, tuple[bytes, str]] = {
    "401 as str2str": (b"HTTP/1.0 401 Unauthorized\r\n", "401 Unauthorized: the caster does not take this password of user 'me'"),
    "401": (b"HTTP/1.1 401 Unauthorized\r\nWWW-Authenticate: Basic\r\n\r\n", "401 Unauthorized: the caster does not take this password"),
    "403": (b"HTTP/1.1 403 Forbidden\r\n\r\n", "may not have"),
    "404": (b"HTTP/1.1 404 Not Found\r\n\r\n", "there is no mount point 'BAS1'"),
    "table v1": (TABLE, "there is no mount point 'BAS1'; did you mean 'BASE1'?"),
    "table v2": (
        b"HTTP/1.1 200 OK\r\nContent-Type: gnss/sourcetable\r\n\r\n" + TABLE.partition(b"\r\n\r\n")[2],
        "there is no mount point 'BAS1'; did you mean 'BASE1'?",
    ),
    "redirect": (b"HTTP/1.1 302 Found\r\nLocation: ntrip://u:hidden@other.example/M\r\n\r\n", "it sends us to ntrip://other.example/M"),
    "web page": (b"HTTP/1.1 200 OK\r\nContent-Type: text/html\r\n\r\n<html>", "a web server answers"),
    "v1 error": (b"ERROR - Bad Password\r\n", "ERROR - Bad Password"),
}


@pytest.mark.parametrize(("sent", "says"), REFUSALS.values(), ids=REFUSALS)
def test_refusals_are_said_in_words_and_not_repeated_soon(world: World, sent: bytes, says: str):
    _, sink = world.source(sends(sent), "?version=2", "BAS1", "me:secret@")
    report = sink.until_state(LinkState.ERROR)
    assert says in report.detail
    assert report.retry_s >= QUICK.refused_first_s
    assert "secret" not in report.detail
    assert "hidden" not in report.detail


FAULTS: dict[str, tuple[bytes, str]] = {
    "endless header": (b"ICY 200 OK\r\n" + b"X-Filler: 1\r\n" * 5000, "without end"),
    "garbage": (b"\x16\x03\x01\x02\x00 not a caster\r\n", "no NTRIP caster"),
    "nothing": (b"", "closed the connection without an answer"),
    "damaged chunks": (CHUNKED + b"xyz\r\n", "no chunk's header"),
}


@pytest.mark.parametrize(("sent", "says"), FAULTS.values(), ids=FAULTS)
def test_nonsense_is_said_and_the_other_version_tried(world: World, sent: bytes, says: str):
    """A caster that makes no sense in version 2 is asked in version 1 next, and the other way round."""

    def script(connection: socket.socket, number: int) -> None:
        connection.sendall(sent if number != 1 else b"ICY 200 OK\r\n" + ALL)
        if number == 1:
            connection.recv(1)

    caster, sink = world.source(script)
    assert says in sink.until_state(LinkState.ERROR).detail
    sink.until_data(ALL)
    assert b"Ntrip-Version: Ntrip/2.0" in caster.request(0)
    assert caster.request(1).startswith(b"GET /BASE1 HTTP/1.0\r\n")


def test_a_busy_caster_says_when_to_come_back(world: World):
    caster, sink = world.source(sends(b"HTTP/1.1 503 Service Unavailable\r\nRetry-After: 60\r\n\r\n", stay=False))
    report = sink.until_state(LinkState.ERROR)
    assert "503 Service Unavailable" in report.detail
    assert report.retry_s >= 60.0
    sink.quiet_for(0.5)
    assert len(caster.requests) == 1


def test_silence_is_left_for_a_new_connection(world: World):
    """Silence from the start is a fault with a hint; a stream that falls silent is only made anew."""

    def script(connection: socket.socket, number: int) -> None:
        connection.sendall(b"ICY 200 OK\r\n" + (FRAMES[number] if number else b""))
        connection.recv(1)

    _, sink = world.source(script, "?timeout=1")
    assert "know a position (gga=on)" in sink.until_state(LinkState.ERROR).detail
    sink.until_data(FRAMES[1] + FRAMES[2])
    assert [report.state for report in sink.reports].count(LinkState.ERROR) == 1


def test_a_mount_point_that_wants_to_know_is_told_the_place_again_and_again(world: World):
    """auto: the table says that VRS wants GGA: nothing is asked before there is a place, then it goes with the request and behind it."""
    heard: queue.Queue[bytes] = queue.Queue()
    known = threading.Event()

    def script(connection: socket.socket, number: int) -> None:
        if number == 0:
            connection.sendall(TABLE)
            return
        connection.sendall(CHUNKED)
        received = b""
        while received.count(b"\n") < 3:
            received += connection.recv(4096)
            if b"\n" in received:
                connection.sendall(chunked(FRAMES[:1]))
        heard.put(received)
        connection.recv(1)

    def find_place() -> Place | None:
        return Place(52.25, 13.5, 77.0) if known.is_set() else None

    caster = world.caster(script)
    sink = world.link(f"ntrip://127.0.0.1:{caster.port}/VRS?gga_period=1", find_place=find_place)
    assert "wants a position" in sink.until_state(LinkState.WAITING).detail
    assert len(caster.requests) == 1
    known.set()
    assert b"\r\nNtrip-GGA: $GPGGA," in caster.request(1)
    lines = heard.get(timeout=PATIENCE_S).splitlines()
    assert [line.split(b",")[2:10] for line in lines] == [b"5215.0000000,N,01330.0000000,E,1,10,1.0,77.000".split(b",")] * 3


def test_a_mount_point_that_does_not_want_to_know_is_told_nothing(world: World):
    def script(connection: socket.socket, number: int) -> None:
        connection.sendall(TABLE if number == 0 else b"ICY 200 OK\r\n" + ALL)
        assert connection.recv(4096) == b""

    caster, sink = world.source(script, "?position=52.5,13.4")
    sink.until_data(ALL)
    assert b"GGA" not in caster.request(1)


@pytest.mark.parametrize("where", ["nearest?gga_period=1", "?nearest&gga_period=1"])
def test_the_nearest_mount_point_is_found_and_changed_when_another_is_much_nearer(world: World, where: str):
    place = Place(52.45, 13.4)

    def script(connection: socket.socket, number: int) -> None:
        connection.sendall(TABLE if number == 0 else b"ICY 200 OK\r\n" + FRAMES[number])
        if number:
            connection.recv(1)

    caster = world.caster(script)
    sink = world.link(f"ntrip://127.0.0.1:{caster.port}/{where}", find_place=lambda: place)
    sink.until_data(FRAMES[1])
    assert caster.request(1).startswith(b"GET /BASE1 ")
    place = Place(52.24, 13.4)  # 2 km nearer to BASE2: not worth losing a fix
    sink.quiet_for(1.3)
    place = Place(52.1, 13.4)
    sink.until_data(FRAMES[1] + FRAMES[2])
    assert caster.request(2).startswith(b"GET /BASE2 ")


def test_a_nearest_mount_point_that_is_too_far_is_refused(world: World):
    _, sink = world.source(sends(TABLE, stay=False), "?position=40,13.4", "nearest")
    assert "the nearest mount point, BASE2, is 1334 km away (max_distance=100)" in sink.until_state(LinkState.ERROR).detail


def certificate(folder: Path, name: str) -> tuple[Path, ssl.SSLContext]:
    """A self-signed certificate for 127.0.0.1 and a server that has it."""
    key, cert = folder / f"{name}.key", folder / f"{name}.pem"
    command = ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-days", "2"]
    names = ["-subj", f"/CN={name}", "-addext", "subjectAltName=IP:127.0.0.1"]
    try:
        subprocess.run([*command, *names, "-keyout", str(key), "-out", str(cert)], check=True, capture_output=True)
    except FileNotFoundError:
        pytest.skip("openssl is not installed")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(cert, key)
    return cert, context


def test_tls_is_verified_unless_told_otherwise(world: World, tmp_path: Path):
    cert, context = certificate(tmp_path, "caster")
    caster = world.caster(sends(CHUNKED, *(chunked([one]) for one in FRAMES)), tls=context)
    url = f"ntrips://me:secret@127.0.0.1:{caster.port}/BASE1"
    report = world.link(url).until_state(LinkState.ERROR)
    assert "its certificate is not trusted: self" in report.detail
    assert report.retry_s >= QUICK.refused_first_s
    assert caster.requests == [], "nobody got the password"
    world.link(f"{url}?ca={cert}").until_data(ALL)
    careless = world.link(f"{url}?verify=no")
    careless.until_data(ALL)
    assert "certificate not verified" in careless.reports[-1].detail


def test_a_plain_caster_at_a_tls_address_is_said(world: World):
    with socket.create_server(("127.0.0.1", 0)) as plain:
        plain.settimeout(PATIENCE_S)
        sink = world.link(f"ntrips://127.0.0.1:{plain.getsockname()[1]}/M")
        connection, _ = plain.accept()
        with connection:
            connection.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")
            assert "no TLS" in sink.until_state(LinkState.ERROR).detail


def test_a_caster_is_never_hammered():
    """An hour of wrong password: 8 attempts; of a caster that is away: about a hundred; of drops after good data: a second each."""

    def attempts(heard_s: float, error: SourceError | OSError | None) -> int:
        pauses, passed_s, count = Pauses(CASTER), 0.0, 0
        while passed_s < 3600.0:
            passed_s += pauses.after(heard_s, error) + heard_s
            count += 1
        return count

    assert attempts(0.0, RefusedError("401", lasting=True)) <= 8
    assert 40 <= attempts(0.0, OSError("refused")) <= 70
    assert 200 < attempts(1.0, None) < 400, "brief connections are no success, but no refusal either: every ten seconds"
    assert attempts(30.0, None) > 100, "drops after good data cost a second"
    assert Pauses(CASTER).after(0.0, RefusedError("429", 120.0)) >= 120.0
    assert Pauses(LOCAL).after(0.0, OSError("refused")) == LOCAL.first_s


# --- RTKLIB's str2str as a caster


@pytest.fixture
def rtklib_caster(rtklib_program: Callable[[str], str], tmp_path: Path) -> Iterator[tuple[int, socket.socket]]:
    """A str2str that serves mount point MP with user u, password p; yields its port and the socket that feeds it."""
    str2str = rtklib_program("str2str")
    with socket.create_server(("127.0.0.1", 0)) as feeder:
        port = free_port()
        feed = f"tcpcli://127.0.0.1:{feeder.getsockname()[1]}"
        out = f"ntripc://u:p@:{port}/MP:MP;RTCM 3.2;1077(1);2;GPS;X;DEU;52.5;13.4;0;0;x;none;B;N;4800;"
        process = subprocess.Popen(
            [str2str, "-in", feed, "-out", out], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        feeder.settimeout(PATIENCE_S)
        try:
            connection, _ = feeder.accept()
            until_listens(port)
            yield port, connection
            connection.close()
        finally:
            process.kill()
            process.wait()


def until_listens(port: int) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline_s:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
    raise AssertionError(f"nobody listens at {port}")


@pytest.mark.rtklib
@pytest.mark.parametrize("version", ["1", "2", "auto"])
def test_every_byte_of_str2strs_caster_arrives(world: World, rtklib_caster: tuple[int, socket.socket], version: str):
    port, feed = rtklib_caster
    sink = world.link(f"ntrip://u:p@127.0.0.1:{port}/MP?version={version}")
    sink.until_state(LinkState.WAITING)
    sent = b""
    for number in range(40):
        feed.sendall(FRAMES[number % 8])
        sent += FRAMES[number % 8]
        if number == 0:
            sink.until_state(LinkState.CONNECTED)
    sink.until_data(sent)


@pytest.mark.rtklib
def test_str2strs_refusals_are_understood(world: World, rtklib_caster: tuple[int, socket.socket]):
    port, _ = rtklib_caster
    says = world.link(f"ntrip://u:wrong@127.0.0.1:{port}/MP").until_state(LinkState.ERROR).detail
    assert "401 Unauthorized: the caster does not take this password of user 'u'" in says
    assert "did you mean 'MP'" in world.link(f"ntrip://u:p@127.0.0.1:{port}/MPX").until_state(LinkState.ERROR).detail
    [row] = fetch_table(CasterAddress("127.0.0.1", port))
    assert (row.name, row.identifier, row.format, row.lat_deg) == ("MP", "MP", "RTCM 3.2", 52.5)
