"""What receivers are told: RTKLIB's command files and lists in the deployment file, to a pseudo-terminal that pyserial opens."""

import os
import pty
import queue
import select
import socket
import termios
import time
import tty
from collections.abc import Iterator
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyubx2 import SET, UBX_MSGIDS, UBXMessage, UBXReader
from tests.patience import PATIENCE_S

from rtkmesh_schemas.config import CommandsTable, IngestTable
from rtkmesh_services.errors import SourceError
from rtkmesh_services.ingest import writer
from rtkmesh_services.ingest.commands import (
    Baud,
    Periodic,
    ReceiverCommands,
    Send,
    Wait,
    commands_of,
    parse_command_file,
    parse_commands,
    parse_line,
    parse_periodic,
)
from rtkmesh_services.ingest.links import Chunk, Link, LinkReport, LinkState
from rtkmesh_services.ingest.ubx_commands import _MESSAGES, ubx_frame
from rtkmesh_services.ingest.urls import parse_source

FILE = """# start: raw messages at 5 Hz
!UBX CFG-RATE 200 1 1   # five a second
!WAIT 100
!HEX b5 0x62 0A 4 0 0 e 34
log versiona once
@
unlogall
@ periodic
$PUBX,00*33 # 2000
!UBX CFG-RST 0 2 0 # 500
$PUBX,04*37
"""


def test_a_command_file_has_three_sections():
    found = parse_command_file(FILE)
    assert found.start == (
        Send(ubx_frame("CFG-RATE 200 1 1")),
        Wait(0.1),
        Send(bytes.fromhex("b5620a0400000e34")),
        Send(b"log versiona once\r\n"),
    )
    assert found.stop == (Send(b"unlogall\r\n"),)
    assert found.periodic == (
        Periodic(Send(b"$PUBX,00*33\r\n"), 2.0),
        Periodic(Send(ubx_frame("CFG-RST 0 2 0")), 0.5),
        Periodic(Send(b"$PUBX,04*37\r\n"), 1.0),
    )


GOLDEN = {  # of a Skybrush server (seed_systems.md 1.5) and of pyubx2 (2.4)
    "CFG-TMODE3 0 0 1 0 0 0 0 0 0 0 0 30 5000": (
        "b562067128000000010000000000000000000000000000000000000000001e00000088130000000000000000000059ca"
    ),
    "CFG-TMODE3 0 0 2 426898712 117889445 457479878 30 60 90 0 200 30": (
        "b562067128000000020018f57119a5d90607c696441b1e3c5a00c80000001e00000000000000000000000000000018d4"
    ),
    "CFG-VALSET 0 1 0 0 CFG-TMODE-MODE 1 TMODE-SVIN_MIN_DUR 60 CFG_TMODE_SVIN_ACC_LIMIT 10000 "
    "MSGOUT-UBX_NAV_SVIN_USB 1 CFG-MSGOUT-RTCM_3X_TYPE1005_USB 5 0x209102cf 1": (
        "b562068a2800000100000100032001100003403c00000011000340102700008b00912001c002912005cf029120013032"
    ),
}


@pytest.mark.parametrize(("text", "frame"), GOLDEN.items(), ids=[text[:12] for text in GOLDEN])
def test_frames_are_those_that_others_send(text: str, frame: str):
    assert ubx_frame(text).hex() == frame


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("CFG-RATE 200 1 1", UBXMessage("CFG", "CFG-RATE", SET, measRate=200, navRate=1, timeRef=1)),
        ("CFG-MSG 0x02 0x15 0 1 0 1", UBXMessage("CFG", "CFG-MSG", SET, msgClass=2, msgID=0x15, rateUART1=1, rateUSB=1)),
        ("CFG-PRT 1 0 0 0x8c0 9600 1", UBXMessage("CFG", "CFG-PRT", SET, portID=1, charLen=3, parity=4, baudRate=9600, inUBX=1)),
        ("CFG-VALGET 0 0 0 RATE-MEAS", UBXMessage.config_poll(0, 0, ["CFG_RATE_MEAS"])),
        ("CFG-VALDEL 0 2 0 0 RATE-MEAS", UBXMessage.config_del(2, 0, ["CFG_RATE_MEAS"])),
        ("CFG-VALSET 0 4 0 0 NAVSPG-USE_PPP -1", None),
    ],
)  # fmt: skip
def test_frames_are_those_of_pyubx2(text: str, message: UBXMessage | None):
    if message is None:
        assert UBXReader.parse(ubx_frame(text), msgmode=SET) is not None
    else:
        assert ubx_frame(text) == message.serialize()


def test_every_message_has_the_id_that_pyubx2_knows():
    """What pyubx2 does not know are messages of receivers before its time."""
    known = {name: key[1] for key, name in UBX_MSGIDS.items() if key[0] == 6}
    wrong = [name for name, (number, _) in _MESSAGES.items() if known.get(f"CFG-{name}", number) != number]
    assert wrong == []
    assert sum(f"CFG-{name}" in known for name in _MESSAGES) > 20


def test_more_arguments_are_bytes_and_missing_ones_zero():
    assert ubx_frame("CFG-RATE")[6:12] == bytes(6)
    blocks = [0, 8, 16, 0, 1, 0, 1, 0, 6, 8, 14, 0, 1, 0, 1, 0]
    assert ubx_frame("CFG-GNSS 0 32 32 2 0 8 16 0 65537 6 8 14 0 1 0 1 0")[6:-2] == bytes([0, 32, 32, 2, *blocks])


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("!UBX CFG-RAT 1", "CFG-RAT: no UBX message"),
        ("!UBX NAV-PVT", "NAV-PVT: no UBX message"),
        ("!UBX CFG-RATE fast", "'fast' does not fit into a field of 2 bytes"),
        ("!UBX CFG-RATE 70000", "'70000' does not fit"),
        ("!UBX CFG-VALSET 0 1 0 0 RATE-MEAS", "keys with a value each"),
        ("!UBX CFG-VALSET 0 1 0 0 RATE-MES 1", "there is no such configuration key"),
        ("!UBX CFG-VALSET 0 1 0 0 0x99 1", "no configuration key"),
        ("!HEX xyz", "hexadecimal"),
        ("!WAIT long", "milliseconds"),
        ("!wait 100", "did you mean !WAIT?"),
        ("!STQ x", "is no command"),
        ("grün", "a receiver takes ASCII"),
    ],
)
def test_wrong_lines_are_named(line: str, says: str):
    with pytest.raises(SourceError) as raised:
        parse_line(line)
    assert says in str(raised.value)


def test_a_wrong_line_of_a_file_has_its_number(tmp_path: Path):
    (tmp_path / "rover.cmd").write_text("# one\n!WAIT 5\n@\n!WIAT 5\n")
    table = IngestTable(source="serial:///dev/ttyACM0", commands=CommandsTable(file="rover.cmd", start=("!WAIT 7",)))
    with pytest.raises(SourceError, match=r"rover\.cmd: line 4: .*did you mean !WAIT"):
        commands_of(table, tmp_path)
    (tmp_path / "rover.cmd").write_text("!WAIT 5")
    assert commands_of(table, tmp_path).start == (Wait(0.005), Wait(0.007))
    with pytest.raises(SourceError, match="commands go to a receiver"):
        commands_of(IngestTable(source="ntrip://host/M", commands=table.commands), tmp_path)


@given(st.text(max_size=80))
def test_any_line_is_a_step_a_comment_or_a_fault(line: str):
    for read in (parse_line, parse_periodic, parse_command_file):
        with suppress(SourceError):
            read(line)


def test_a_wait_is_bounded_and_a_baud_is_a_number():
    assert (parse_line("!WAIT 60000"), parse_line("!BRATE 460800")) == (Wait(3.0), Baud(460800))


class Terminal:
    """The receiver's end of a pseudo-terminal."""

    def __init__(self) -> None:
        self.master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)
        self.heard = b""

    def until(self, expected: bytes) -> float:
        """Read until something was said; return when."""
        deadline_s = time.monotonic() + PATIENCE_S
        while expected not in self.heard:
            assert time.monotonic() < deadline_s, f"heard {self.heard!r}"
            if select.select([self.master], [], [], 0.1)[0]:
                self.heard += os.read(self.master, 4096)
        _, _, self.heard = self.heard.partition(expected)
        return time.monotonic()

    def baud(self) -> int:
        speeds = {getattr(termios, name): int(name[1:]) for name in dir(termios) if name[0] == "B" and name[1:].isdigit()}
        return speeds[termios.tcgetattr(self.master)[4]]

    def close(self) -> None:
        os.close(self.master)
        os.close(self._slave)


@pytest.fixture
def terminal() -> Iterator[Terminal]:
    terminal = Terminal()
    yield terminal
    terminal.close()


def link(url: str, commands: ReceiverCommands) -> Link:
    items: queue.Queue[Chunk | LinkReport] = queue.Queue()
    made = Link(parse_source(url), items.put, commands=commands)
    made.start()
    return made


def test_a_receiver_is_told_at_the_start_and_at_the_end(terminal: Terminal, monkeypatch: pytest.MonkeyPatch):
    slept_s = list[float]()
    monkeypatch.setattr(writer, "time", SimpleNamespace(monotonic=time.monotonic, sleep=slept_s.append))
    commands = parse_commands(["first", "!WAIT 200", "second", "!BRATE 460800", "third"], ["last"], [])
    port = link(f"serial://{terminal.path}?baud=38400", commands)
    terminal.until(b"first\r\n")
    terminal.until(b"second\r\n")
    assert slept_s == [0.2]
    terminal.until(b"third\r\n")
    assert terminal.baud() == 460800
    assert port.write(b"correction")
    terminal.until(b"correction")
    begun_s = time.monotonic()
    port.stop(PATIENCE_S)
    assert time.monotonic() - begun_s < PATIENCE_S / 2.0
    terminal.until(b"last\r\n")


def test_a_restart_says_farewell_and_hello_and_never_finds_the_port_in_use(terminal: Terminal):
    commands = parse_commands(["hello"], ["bye"], [])
    items: queue.Queue[Chunk | LinkReport] = queue.Queue()
    links = [Link(parse_source(f"serial://{terminal.path}"), items.put, commands=commands) for _ in range(3)]
    took_s = list[float]()
    for number, port in enumerate(links):
        port.start(links[number - 1] if number else None)
        terminal.until(b"hello\r\n")
        begun_s = time.monotonic()
        port.stop()
        took_s.append(time.monotonic() - begun_s)
        if number == len(links) - 1:
            terminal.until(b"bye\r\n")
    assert min(took_s) < 0.05, "no stop waits for the farewell"
    reports = [item for item in [items.get() for _ in range(items.qsize())] if isinstance(item, LinkReport)]
    assert [report.detail for report in reports if report.state is LinkState.ERROR] == []


def test_periodic_commands_keep_their_periods_and_let_corrections_through(terminal: Terminal):
    port = link(f"serial://{terminal.path}", parse_commands([], [], ["quick # 100", "slow # 400"]))
    instants_s = [terminal.until(b"quick\r\n")]
    for number in range(10):
        assert port.write(b"<%d>" % number)
        terminal.until(b"<%d>" % number)
        instants_s.append(terminal.until(b"quick\r\n"))
    apart_s = sorted(later_s - before_s for before_s, later_s in pairwise(instants_s))
    assert 0.05 < apart_s[5] < 0.2, "the machine may stand still in some of them"
    port.stop()


def test_a_receiver_that_comes_back_is_told_again():
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(PATIENCE_S)
        port = link(f"tcp://127.0.0.1:{server.getsockname()[1]}", parse_commands(["hello"], [], []))
        for _ in range(3):
            connection, _ = server.accept()
            connection.settimeout(PATIENCE_S)
            assert connection.recv(7) == b"hello\r\n"
            connection.close()
        port.stop()
