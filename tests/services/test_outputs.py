"""A solver's output streams on real sockets, ports and files: each with its own options, none waits for another, each comes back."""

import base64
import os
import pty
import socket
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import suppress
from math import hypot
from pathlib import Path

import pytest
from tests.patience import PATIENCE_S, all_but_a_few
from tests.services.scripted_caster import ScriptedCaster
from tests.services.text_world import TOW_S, TextWorld, lines, none, received, satellites, solution

from rtkmesh.gnss.time import GpsTime
from rtkmesh_schemas.config import OutputTable, SolverTable
from rtkmesh_schemas.keys import EVENT, SAT, SOL, WRITE
from rtkmesh_services.ntrip.address import CasterAddress
from rtkmesh_services.ntrip.connection import fetch_table
from rtkmesh_services.ntrip.protocol import AnswerReader
from rtkmesh_services.output.outlets import SEND_S, SocketOutlet
from rtkmesh_services.output.text_feed import HOLD_NS, TextFeed, about
from rtkmesh_services.runtime.clock import ManualClock
from rtkmesh_services.runtime.time_tags import parse_tag

FIXES = [solution(number) for number in range(10)]


def table(target: str, **options: object) -> OutputTable:
    return OutputTable(target=target, solver="rtk", **options)  # type: ignore[arg-type]


def client(port: int) -> socket.socket:
    deadline_s = time.monotonic() + PATIENCE_S
    while True:
        try:
            return socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S)
        except ConnectionRefusedError:
            assert time.monotonic() < deadline_s
            time.sleep(0.005)


@pytest.fixture
def server() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(PATIENCE_S)
        yield server


# --- what is written


def test_outputs_of_one_solver_differ_in_everything(tmp_path: Path) -> None:
    tables = {
        "one": table(f"file://{tmp_path}/one.pos", separator=",", time_form="tow", time_decimals=1, header="none"),
        "two": table(f"file://{tmp_path}/two.pos", format="enu", dialect="2.4", interval_s=1.0),
        "three": table(f"file://{tmp_path}/three.json", format="json"),
    }
    with TextWorld(**tables) as world:
        world.solve(*FIXES)
    one, two, three = (lines((tmp_path / name).read_bytes()) for name in ("one.pos", "two.pos", "three.json"))
    assert [len(one), len(two), len(three)] == [10, 2, 10]
    assert one[1].split(",")[:2] == ["2390", "345600.2"]
    assert [hypot(*map(float, line.split()[2:5])) for line in two] == [pytest.approx(hypot(1.0, 2.0, 3.0), abs=1e-3)] * 2
    assert b"\r\n" in (tmp_path / "one.pos").read_bytes()
    assert b"\r\n" not in (tmp_path / "two.pos").read_bytes()
    assert (tmp_path / "two.pos").read_text().startswith("% program   : rtkmesh")
    assert (tmp_path / "one.pos").read_text()[0] != "%"
    assert '"status":1' in three[0]


@pytest.mark.parametrize(
    ("options", "solutions", "expected"),
    [
        ({}, [solution(0, status=5), solution(1, status=4), none(2), solution(3)], [4, 1]),
        ({"single": True}, [solution(0, status=5), none(1), solution(2, status=2)], [5, 2]),
        ({}, [solution(0, status=5, mode="single")], [5]),
        ({"max_sigma_m": 0.03}, [solution(0), solution(1, position_cov_ecef_m2=(1e-3, 0, 0, 0, 1e-4, 0, 0, 0, 1e-4)), solution(2)], [1, 1]),
        ({"max_sigma_m": 0.031}, [solution(0, status=2)], [2]),
        ({"interval_s": 0.5}, [solution(number) for number in range(10)], [1, 1]),
        ({"interval_s": 0.4}, [solution(number, tow_s=TOW_S + 0.2 * number + 0.0004) for number in range(10)], [1] * 5),
    ],
)
def test_which_epochs_are_written(options: dict[str, object], solutions: list, expected: list[int]) -> None:
    """outsingle, maxsolstd and the interval, on clocks that are not steered too."""
    feed = TextFeed(table("stdout://", **options), SolverTable(rover="a", base="b"))
    texts = b"".join(text for one in solutions for text in feed.solution(one, 0))
    assert [int(line.split()[5]) for line in lines(texts)] == expected


def test_an_epoch_waits_for_its_satellites_and_no_longer() -> None:
    """Those of its own epoch go with it; when those of a later one come, or none, it is written without."""
    feed = TextFeed(table("stdout://", format="stat", status_level="residual"), SolverTable(rover="a", base="b"))
    assert list(feed.solution(solution(0), 0)) == []
    [first] = feed.satellites(satellites(0), 1)
    assert first.count(b"$SAT") == 3
    assert list(feed.solution(solution(1), 2)) == list(feed.solution(solution(2), 3)) == []
    second, third = feed.satellites(satellites(2), 4)
    assert (second.count(b"$POS"), second.count(b"$SAT"), third.count(b"$SAT")) == (1, 0, 3)
    assert list(feed.satellites(satellites(3), 5)) == []
    [fourth] = feed.solution(solution(3), 6)
    assert fourth.count(b"$SAT") == 3
    assert list(feed.solution(solution(4), 10)) == list(feed.overdue(int(feed.due_ns()) - 1)) == []
    assert feed.due_ns() == 10 + HOLD_NS
    [fifth] = feed.overdue(int(feed.due_ns()))
    assert fifth.count(b"$SAT") == 0
    list(feed.solution(solution(5), 20))
    assert len(list(feed.rest())) == 1


def test_sentences_do_not_wait_for_satellites_that_come_once_a_second() -> None:
    """A solver that began before the output was there: after three epochs the newest satellites do."""
    feed = TextFeed(table("stdout://", format="nmea"), SolverTable(rover="a", base="b"))
    at_once = 0
    for number in range(40):
        texts = list(feed.solution(solution(number), 2 * HOLD_NS * number))
        at_once += len(texts) == 1
        if number % 5 == 0:
            list(feed.satellites(satellites(number), 2 * HOLD_NS * number + 1))
    assert at_once >= 33
    assert b"GSV" in texts[0]
    for number in range(40, 50):
        list(feed.solution(solution(number), 2 * HOLD_NS * number))
        texts = list(feed.satellites(satellites(number), 2 * HOLD_NS * number + 1))
    assert len(texts) == 1


def test_only_outputs_that_write_satellites_listen_to_them(tmp_path: Path) -> None:
    for format_, expected in (("llh", False), ("nmea", True), ("stat", False)):
        with TextWorld(out=table(f"file://{tmp_path}/{format_}", format=format_)) as world:
            assert world.solver.matched(SAT) is expected


def test_marks_go_into_the_texts(tmp_path: Path) -> None:
    """As RTKRCV writes them, between the epochs before and after."""
    outs = {name: table(f"file://{tmp_path}/{name}", format=name) for name in ("llh", "nmea", "json")}
    with TextWorld(**outs) as world:
        world.solve(solution(0))
        world.mark(name="P1", comment="corner", week=2390, tow_s=TOW_S, status=1, lat_deg=47.4, lon_deg=8.5, height_m=480.0)
        world.solve(solution(1))
    text = (tmp_path / "llh").read_text().splitlines()
    marks = [number for number, line in enumerate(text) if line.startswith("% MARK: P1,")]
    assert marks == [len(text) - 2]
    assert text[marks[0]].endswith(",1,corner")
    assert "MARK:P1" in (tmp_path / "nmea").read_text()
    assert '{"mark":{"name":"P1"' in (tmp_path / "json").read_text()


def test_what_has_come_is_written_at_the_end(tmp_path: Path) -> None:
    """Also what waits in the inbox or for its satellites: a replay's last epochs."""
    with TextWorld(out=table(f"file://{tmp_path}/out", format="stat", status_level="residual")) as world:
        for number in range(10):
            world.solver.publish(SOL, solution(number))
    assert (tmp_path / "out").read_bytes().count(b"$POS") == 10


def test_headers_tell_the_options_of_the_solver() -> None:
    solver = SolverTable(rover="a", base="b", mode="static", frequencies=3, systems="GE", elevation_mask_deg=10.0)
    told = dict(about(solver).options)
    assert (told["pos mode"], told["freqs"], told["elev mask"], told["navi sys"]) == ("static", "L1+L2+L5", "10.0 deg", "gps galileo")
    with_options = TextFeed(table("stdout://", header_options=True), solver).header.decode()
    assert "% pos mode  : static" in with_options
    assert "pos mode" not in TextFeed(table("stdout://"), solver).header.decode()


def test_damaged_messages_are_counted(tmp_path: Path) -> None:
    with TextWorld(out=table(f"file://{tmp_path}/out.pos")) as world:
        world.solver.publish(SOL, b"\x01junk")
        world.solver.publish(EVENT, b"\xff", level="info")
        world.solve(solution(0), solution(3))
        status = world.status()
    assert status.counters["errors"] == 2
    assert (status.inputs[0].name, status.inputs[0].messages, status.inputs[0].lost) == ("rtk", 2, 2)
    assert status.last_epoch == (2390, TOW_S + 0.6)


# --- files


def test_a_file_is_swapped_with_a_margin_and_tagged(tmp_path: Path) -> None:
    """Both files have what comes around the hour (RTKLIB's misc-fswapmargin); the tag says when; a new start is a new file."""
    start = GpsTime(2390, TOW_S - 60.0)
    clock = ManualClock(utc_ns=int(start.to_utc().timestamp() * 1e9))
    tables = {"out": table(f"file://{tmp_path}/%h.pos::T?swap=1&margin=30", header="none")}
    with TextWorld(clock, **tables) as world:
        for number in range(12):
            world.solve(solution(number))
            clock.advance(10.0)
    with TextWorld(clock, **tables) as world:
        world.solve(solution(12))
    count = {path.name: len(lines(path.read_bytes())) for path in tmp_path.glob("*.pos")}
    assert count == {"23.pos": 9, "00.pos": 9, "00-1.pos": 1}
    tags = parse_tag((tmp_path / "23.pos.tag").read_bytes(), (tmp_path / "23.pos").stat().st_size)
    assert tags is not None
    assert tags.instants_s[:3] == pytest.approx([0.0, 10.0, 20.0])
    assert tags.offsets[-1] == (tmp_path / "23.pos").stat().st_size
    assert abs(tags.start - start) < 0.01


def test_a_file_that_cannot_be_made_is_told_once_and_tried_again(tmp_path: Path) -> None:
    folder = tmp_path / "disk"
    folder.write_text("a file where a folder should be")
    clock = ManualClock()
    with TextWorld(clock, out=table(f"file://{folder}/out.pos")) as world:
        assert world.status().state.value == "DEGRADED"
        for number in range(3):
            world.solve(solution(number))
            clock.advance(0.4)
        assert world.status().counters["lines_lost"] == 3
        folder.unlink()
        clock.advance(1.1)
        world.solve(solution(3))
        assert world.state() == "RUNNING"
        assert [code for code in world.events() if code != "writing"] == ["output_failed", "output_back"]
    assert len(lines((folder / "out.pos").read_bytes())) == 1


def test_a_full_disk_is_told_once_and_nothing_is_lost_when_there_is_room_again(small_disk: Path) -> None:
    """What is refused waits; the file goes on where it stopped."""
    filler = small_disk / "filler"
    with TextWorld(out=table(f"file://{small_disk}/out.pos")) as world:
        world.solve(solution(0))
        world.until(lambda: lines((small_disk / "out.pos").read_bytes()))
        with suppress(OSError):
            filler.write_bytes(bytes(1 << 20))
        count = 200  # more than the last page of the file takes, less than the disk has when there is room again
        world.solve(*(solution(number) for number in range(1, count)))
        world.until(lambda: world.state() == "DEGRADED")
        assert "No space left" in world.status().reason
        filler.unlink()
        world.until(lambda: world.state() == "RUNNING")
        assert [code for code in world.events() if code != "writing"] == ["output_failed", "output_back"]
    assert len(lines((small_disk / "out.pos").read_bytes())) == count


# --- sockets


def test_every_client_gets_the_header_and_everything_from_then_on(free_port: Callable[[], int]) -> None:
    port = free_port()
    with TextWorld(out=table(f"tcp-listen://127.0.0.1:{port}")) as world, client(port) as first:
        world.until(lambda: len(world.status().inputs) == 3)
        world.solve(*FIXES[:5])
        with client(port) as second:
            world.until(lambda: len(world.status().inputs) == 4)
            world.solve(*FIXES[5:])
            texts = [received(one.recv, lambda data: b"00:00:01.800" in data and data.endswith(b"\n")) for one in (first, second)]
        assert [text.startswith(b"% program") for text in texts] == [True, True]
        assert [len(lines(text)) for text in texts] == [10, 5]
        world.until(lambda: len(world.status().inputs) == 3)
        assert world.state() == "RUNNING"


def test_a_client_that_does_not_read_harms_nobody(free_port: Callable[[], int]) -> None:
    """It loses the oldest; the loop and the others go on; the operator is told once."""
    port = free_port()
    with TextWorld(out=table(f"tcp-listen://127.0.0.1:{port}", format="json")) as world:
        stuck = socket.socket()
        stuck.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        stuck.settimeout(PATIENCE_S)
        client(port).close()  # it listens
        stuck.connect(("127.0.0.1", port))
        with stuck, client(port) as quick:
            names = {f"client 127.0.0.1:{one.getsockname()[1]}" for one in (stuck, quick)}
            world.until(lambda: {row.name for row in world.status().inputs} >= names)
            got, took_s, number = b"", list[float](), 0
            while not world.status().counters["lines_lost"]:
                begun_s = time.monotonic()
                world.solve(solution(number))
                took_s.append(time.monotonic() - begun_s)
                got += quick.recv(65536)
                number += 1
                assert number < 20000
            while got.count(b"\n") < number:
                got += quick.recv(65536)
            assert got.count(b'"sequence":') == number
            assert all_but_a_few(took_s) < 0.1
            world.until(lambda: "too slow" in world.status().reason)
            assert world.events().count("output_slow") == 1
            row = next(row for row in world.status().inputs if row.dropped and row.name.startswith("client"))
            assert row.messages < number


def test_more_clients_than_allowed_are_turned_away(free_port: Callable[[], int]) -> None:
    port = free_port()
    with TextWorld(out=table(f"tcp-listen://127.0.0.1:{port}", maximum_clients=1)) as world, client(port):
        world.until(lambda: len(world.status().inputs) == 3)
        with client(port) as second:
            assert second.recv(100) == b""
        assert world.status().inputs[1].errors == 1


def test_a_busy_port_is_told_and_waited_for(server: socket.socket) -> None:
    port = server.getsockname()[1]
    with TextWorld(out=table(f"tcp-listen://127.0.0.1:{port}")) as world:
        world.until(lambda: world.state() == "DEGRADED")
        assert "in use" in world.status().reason
        server.close()
        client(port).close()
        world.until(lambda: world.state() == "RUNNING")
        assert world.events() == ["output_failed", "output_back"]


def test_a_server_that_is_away_is_told_once_and_found_again(free_port: Callable[[], int]) -> None:
    """What it missed in the meantime it gets, behind the header; each connection begins with one."""
    port = free_port()
    with TextWorld(out=table(f"tcp://127.0.0.1:{port}", maximum_delay_s=60.0)) as world:
        world.until(lambda: world.state() == "DEGRADED")
        assert "refused" in world.status().reason
        world.solve(*FIXES[:3])
        with socket.create_server(("127.0.0.1", port)) as server:
            server.settimeout(PATIENCE_S)
            connection, _ = server.accept()
            with connection:
                text = received(connection.recv, lambda data: len(lines(data)) == 3 and data.endswith(b"\n"))
                assert text.startswith(b"% program")
                world.until(lambda: world.state() == "RUNNING")
            connection, _ = server.accept()
            with connection:
                world.solve(*FIXES[3:])
                text = received(connection.recv, lambda data: data.count(b"00:00:01.800") == 1 and data.endswith(b"\n"))
                assert text.startswith(b"% program")
        assert world.events().count("output_failed") == world.events().count("output_back") >= 1


def test_what_waits_too_long_is_dropped_and_counted(free_port: Callable[[], int]) -> None:
    with TextWorld(out=table(f"tcp://127.0.0.1:{free_port()}", maximum_delay_s=0.1)) as world:
        world.solve(*FIXES[:5])
        deadline_s = time.monotonic() + PATIENCE_S
        while world.status().counters["lines_lost"] < 5:
            assert time.monotonic() < deadline_s
            world.solve(solution(5, status=0))  # nothing to write
            world.solve(solution(6))


def test_a_server_that_does_not_read_makes_nobody_wait(server: socket.socket) -> None:
    server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    with TextWorld(out=table(f"tcp://127.0.0.1:{server.getsockname()[1]}", format="json")) as world:
        connection, _ = server.accept()
        took_s = list[float]()
        while not world.status().counters["lines_lost"]:
            begun_s = time.monotonic()
            world.solve(solution(len(took_s)))
            took_s.append(time.monotonic() - begun_s)
            assert len(took_s) < 20000
        assert all_but_a_few(took_s) < 0.1
        world.until(lambda: world.status().state.value == "DEGRADED")
        begun_s = time.monotonic()
        world.close()
        assert time.monotonic() - begun_s < SEND_S / 2.0
        world.lives.clear()
        connection.close()


def test_an_end_that_comes_while_we_look_at_the_connection_is_the_end_of_it(server: socket.socket) -> None:
    """The work loop closes what a slow thread still has: an error of the connection, not of the program."""
    outlet = SocketOutlet(client(server.getsockname()[1]), "there")
    with server.accept()[0]:
        outlet.check()
        outlet.close()
        with pytest.raises(OSError, match="closed by us"):
            outlet.check()


@pytest.mark.parametrize("host", ["127.0.0.1", "127.255.255.255"])
def test_datagrams_carry_an_epoch_each(host: str) -> None:
    """Also as a broadcast; nobody has to listen, and there is no header."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind((host, 0))
        listener.settimeout(PATIENCE_S)
        with TextWorld(out=table(f"udp://{host}:{listener.getsockname()[1]}", format="xyz")) as world:
            world.solve(*FIXES[:3])
            texts = [listener.recv(65536) for _ in range(3)]
            assert [text.count(b"\n") for text in texts] == [1, 1, 1]
            assert lines(b"".join(texts))[2].startswith("2025/10/30 00:00:00.400")
        with TextWorld(out=table("udp://127.0.0.1:9")) as world:
            world.solve(*FIXES)
            world.until(lambda: world.status().inputs[1].messages == 10)
            assert world.state() == "RUNNING"


# --- serial ports


@pytest.fixture
def port(tmp_path: Path) -> Iterator["Port"]:
    port = Port(tmp_path / "ttyOUT")
    yield port
    port.unplug()


class Port:
    """A serial port that can be plugged in and out."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.master = -1
        self.plug()

    def plug(self) -> None:
        self.master, slave = pty.openpty()
        tty.setraw(slave)
        self.path.symlink_to(os.ttyname(slave))
        os.close(slave)

    def unplug(self) -> None:
        if self.master >= 0:
            os.close(self.master)
            self.path.unlink()
        self.master = -1

    def read(self, count: int) -> bytes:
        while True:
            try:
                return os.read(self.master, count)
            except OSError:  # nobody has it open yet
                time.sleep(0.005)


def test_a_serial_port_is_written_and_found_again_after_unplugging(port: Port) -> None:
    with TextWorld(out=table(f"serial://{port.path}?baud=9600", format="enu")) as world:
        world.until(lambda: world.status().inputs[1].state == "connected")
        assert world.status().inputs[1].detail == f"{port.path} at 9600 baud"
        world.solve(*FIXES[:5])
        text = received(port.read, lambda data: len(lines(data)) == 5 and data.endswith(b"\n"))
        assert text.startswith(b"% program")
        port.unplug()
        world.until(lambda: world.state() == "DEGRADED")
        world.solve(*FIXES[5:])
        port.plug()
        text = received(port.read, lambda data: data.count(b"00:00:01.800") == 1 and data.endswith(b"\n"))
        assert len(lines(text)) == 5
        world.until(lambda: world.state() == "RUNNING")
        assert world.events() == ["output_failed", "output_back"]


@pytest.mark.parametrize("target", ["serial://{port}", "ingest://rover"])
def test_a_receivers_own_port_is_written_by_its_ingest(port: Port, target: str) -> None:
    """The ingest owns it: the text goes to its key, the device is not opened."""
    out = table(target.format(port=port.path), format="nmea", nmea_satellites_interval_s=-1.0)
    with TextWorld(source=f"serial://{port.path}?baud=38400", out=out) as world:
        writes: list[bytes] = []
        world.solver.subscribe(WRITE.key("rover"), lambda sample: writes.append(sample.payload))
        world.solve(*FIXES[:2])
        assert [b"GGA" in text for text in writes] == [True, True]
        assert world.status().inputs[1].detail == WRITE.key("rover")


# --- casters and keys


@pytest.mark.parametrize(("user", "chunked"), [("user:secret@", True), (":secret@", False)])
def test_a_text_is_pushed_to_a_caster_with_its_header_first(user: str, chunked: bool) -> None:
    """In both versions of NTRIP."""
    texts: list[bytes] = []

    def script(connection: socket.socket, number: int) -> None:
        connection.sendall(b"HTTP/1.1 200 OK\r\n\r\n" if chunked else b"ICY 200 OK\r\n")
        reader = AnswerReader()
        reader.feed(b"HTTP/1.1 200 OK\r\n" + (b"Transfer-Encoding: chunked\r\n" if chunked else b"") + b"\r\n")
        texts.append(received(lambda count: reader.feed(connection.recv(count)), lambda data: b"00:00:01.800" in data))

    caster = ScriptedCaster(script)
    with TextWorld(out=table(f"ntrip://{user}127.0.0.1:{caster.port}/POS")) as world:
        world.solve(*FIXES)
        world.until(lambda: len(texts) == 1)
    caster.close()
    assert texts[0].startswith(b"% program")
    assert len(lines(texts[0])) == 10


def test_our_caster_serves_a_solvers_text_at_a_mount_point(free_port: Callable[[], int]) -> None:
    port = free_port()
    out = table(f"ntrip-caster://127.0.0.1:{port}/POS", users={"me": "pw"})
    with TextWorld(out=out) as world, client(port) as reader:
        password = base64.b64encode(b"me:pw").decode()
        reader.sendall(f"GET /POS HTTP/1.0\r\nAuthorization: Basic {password}\r\n\r\n".encode())
        world.until(lambda: len(world.status().inputs) == 3)
        world.solve(*FIXES)
        text = received(reader.recv, lambda data: b"00:00:01.800" in data and data.endswith(b"\n"))
        assert text.removeprefix(b"ICY 200 OK\r\n\r\n").startswith(b"% program")
        assert len(lines(text.partition(b"\r\n\r\n")[2])) == 10
        [row] = fetch_table(CasterAddress("127.0.0.1", port))
        assert (row.name, row.identifier, row.format) == ("POS", "rtk", "RTKLIB llh")


@pytest.mark.parametrize(("target", "key"), [("zenoh://", "rtk/out/text"), ("zenoh://boat/position", "boat/position")])
def test_a_text_is_a_stream_of_the_network(target: str, key: str) -> None:
    with TextWorld(out=table(target)) as world:
        world.solve(*FIXES[:2])
        samples = [sample for sample in world.network.sent if sample.key == key]
        assert [sample.payload.count(b"\n") for sample in samples] == [1, 1]
        assert samples[0].attachment.startswith(b"% program")
        assert world.status().inputs[1].detail == key
