"""The telnet console: a script for rtkrcv runs unchanged; passwords, limits and hostile clients."""

import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.patience import until
from tests.services.old_script import (
    ECHOES,
    GREETING,
    LOGIN,
    PASSWORD,
    SATELLITE_HEAD,
    STARS,
    STATUS_HEAD,
    OldScript,
    echo_of,
    run_old_script,
)
from tests.services.told_solver import Solver

from rtkmesh_schemas.command import Code, Reply
from rtkmesh_schemas.config import Deployment
from rtkmesh_schemas.config_telnet import TelnetTable
from rtkmesh_schemas.errors import ConfigError
from rtkmesh_schemas.keys import EVENT, Role
from rtkmesh_schemas.status import Event
from rtkmesh_schemas.wire import decode
from rtkmesh_services.control.telnet.editor import MAXIMUM_LINE, Kind, LineEditor, Said
from rtkmesh_services.control.telnet.screens import shown, wire
from rtkmesh_services.control.telnet.server import TelnetServer
from rtkmesh_services.control.telnet.servers import TelnetServers
from rtkmesh_services.control.telnet.throttle import LOCKED_AFTER, MAXIMUM_ADDRESSES, MEMORY_S, Throttle
from rtkmesh_services.runtime.bus import Sample
from rtkmesh_services.runtime.configuration import parse_deployment
from rtkmesh_services.runtime.service import Context, accepted, done


class Consoles:
    """Makes telnet consoles on free ports; events of theirs are kept."""

    def __init__(self, site: Any, free_port: Callable[[], int]) -> None:
        self.bus = site.bus("control")
        self.context = Context(id="control", role=Role.CONTROL, deployment=Deployment(), bus=self.bus)
        self.events: list[Event] = []
        self._free_port = free_port
        self._servers: list[TelnetServer] = []
        self.bus.subscribe(EVENT.expression(), self._take)

    def _take(self, sample: Sample) -> None:
        self.events.append(decode(Event, sample.payload, sample.encoding))

    def open(self, **fields: Any) -> TelnetServer:
        table = TelnetTable(**{"solver": "rtk", "listen": f"127.0.0.1:{self._free_port()}", "password": PASSWORD.decode(), **fields})
        server = TelnetServer("site", table, self.context)
        server.start()
        self._servers.append(server)
        return server

    def codes(self) -> list[str]:
        return [event.code for event in self.events]

    def close(self) -> None:
        for server in self._servers:
            server.close()
        self.bus.close()


@pytest.fixture
def consoles(site: Any, free_port: Callable[[], int]) -> Iterator[Consoles]:
    consoles = Consoles(site, free_port)
    yield consoles
    consoles.close()


@pytest.fixture
def rtkrcv(tmp_path: Path, free_port: Callable[[], int], rtklib_program: Callable[[str], str]) -> Iterator[int]:
    """The port of the telnet console of a real rtkrcv."""
    (tmp_path / "rtkrcv.conf").write_text("inpstr1-type =off\nconsole-passwd =secret\n")
    port = free_port()
    command = [rtklib_program("rtkrcv"), "-p", str(port), "-o", "rtkrcv.conf", "-w", PASSWORD.decode()]
    process = subprocess.Popen(command, cwd=tmp_path, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    until(lambda: listens(port))
    yield port
    process.kill()
    process.communicate()


def listens(port: int) -> bool:
    """Whether somebody listens, without connecting: rtkrcv has few places."""
    hexadecimal = f":{port:04X} 00000000:0000 0A"
    return any(hexadecimal in line for line in Path("/proc/net/tcp").read_text().splitlines())


def check_transcript(seen: dict[str, bytes]) -> None:
    """What a script relies on, in rtkrcv's bytes."""
    assert seen["login"].startswith(GREETING)
    assert seen["login"].endswith(LOGIN + STARS * len(PASSWORD) + b"\r\nrtkrcv> ")
    assert seen["status"].startswith(echo_of(b"status") + STATUS_HEAD)
    rows = [line.partition(b":") for line in seen["status"].split(b"\r\n")[3:-1]]
    assert all(len(name) == 28 and sign and value.startswith((b" ", b"")) for name, sign, value in rows), rows
    assert b"rtk server state            : " in seen["status"]
    assert seen["satellite"].startswith(echo_of(b"satellite") + SATELLITE_HEAD)
    assert seen["cycle"] == echo_of(b"status 1") + b"\x1b[H\x1b[2J" + STATUS_HEAD
    assert seen["after cycle"].endswith(b"\r\n^C\r\n\r\nrtkrcv> ")
    assert seen["unknown"] == echo_of(b"nonsense") + b"unknown command: nonsense.\r\n"
    assert echo_of(b"exit").startswith(seen["exit"])  # rtkrcv hangs up so hard that the rest may be lost


@pytest.mark.rtklib
@pytest.mark.e2e
def test_the_script_runs_with_rtkrcv(rtkrcv: int):
    """The authority: what the script expects is what rtkrcv sends."""
    check_transcript(run_old_script(rtkrcv))


@pytest.mark.rtklib
@pytest.mark.e2e
def test_the_echoes_are_those_of_rtkrcv(rtkrcv: int):
    """The authority of the table of echoes."""
    script = OldScript(rtkrcv)
    script.log_in()
    for sent, echo in ECHOES:
        assert script.ask(sent).startswith(echo), sent
    script.send(b"\x04")
    script.to_the_end()


@pytest.mark.e2e
def test_the_script_runs_unchanged_with_us(solver: Solver, consoles: Consoles):
    """The same script, the same checks; the solver has seen who asked."""
    server = consoles.open()
    seen = run_old_script(server.port)
    check_transcript(seen)
    assert b"(FIX  ) N: 35" in seen["solution"]
    callers = {request.caller for request in solver.service.asked}
    assert callers == {"telnet site 127.0.0.1 #1"}
    until(lambda: "telnet_left" in consoles.codes())
    assert [code for code in consoles.codes() if code.startswith("telnet")] == ["telnet_login", "telnet_left"]


@pytest.mark.e2e
def test_words_and_what_is_said_to_wrong_ones(solver: Solver, consoles: Consoles):
    """Abbreviations where they are clear, no last one wins, nothing asks back, no shell, no shutdown by accident."""
    script = OldScript(consoles.open().port)
    script.log_in()
    assert script.ask(b"so\r\n").endswith(b" N: 9\r\n")
    assert b"ambiguous command: sa. (satellite, save)\r\n" in script.ask(b"sa\r\n")
    assert b"(start, status)" in script.ask(b"sta\r\n")
    assert b"rtk server start error (server already started)\r\n" in script.ask(b"start\r\n")
    assert b"specify option type\r\n" in script.ask(b"set\r\n")
    assert b"specify option value\r\n" in script.ask(b"set pos1-elmask\r\n")
    assert b"set done\r\n" in script.ask(b"set pos1-elmask 20\r\n")
    assert solver.service.asked[-1].args == {"key": "pos1-elmask", "value": 20}
    assert b"not allowed" in script.ask(b"!ls\r\n")
    assert b"unknown command: shut" in script.ask(b"shut\r\n")
    assert b"not allowed here" in script.ask(b"shutdown\r\n")
    assert b"did you mean" in script.ask(b"mode fast\r\n") or b"no operation" in script.ask(b"mode fast\r\n")
    page = script.ask(b"?\r\n")
    assert b"solution [cycle]      : show solution\r\n" in page
    assert all(len(line.partition(b":")[0]) == 22 for line in page.split(b"\r\n")[2:-1]), page
    assert b"line too long.\r\n" in script.ask(b"x" * 300 + b"\r\n")
    script.send(b"\x04")
    assert script.to_the_end() == b""


@pytest.mark.e2e
def test_a_cycle_ends_at_any_key(solver: Solver, consoles: Consoles):
    """A lone key is forgotten, a line that was typed is done, telnet's own words are no key."""
    script = OldScript(consoles.open().port)
    script.log_in()
    for key in (b"q", b"\r\n", b" "):
        script.send(b"status 0.1\r\n")
        script.expect(b"\x1b[2J")
        script.expect(b"\x1b[2J")
        script.send(key)
        script.expect(b"\r\n\r\nrtkrcv> ")
    script.send(b"satellite 0.1\r\n")
    script.expect(b"\x1b[2J")
    script.send(b"\xff\xfd\x03")
    script.expect(b"\xff\xfb\x03")
    script.expect(b"\x1b[2J")
    script.send(b"so\r\n")
    script.expect(b"\r\nrtkrcv> ")
    assert b"(FIX  )" in script.expect(b"rtkrcv> ")
    assert script.ask(b"\r\n") == b"\r\n"
    script.close()


@pytest.mark.e2e
def test_wrong_passwords_cost_time_and_then_the_connection(consoles: Consoles):
    """Five are enough; each answer is held back for longer; the next connection begins where the last one ended."""
    server = consoles.open()
    script = OldScript(server.port)
    begun_s = time.monotonic()
    for _ in range(3):
        assert script.expect(b"password: ")
        script.send(b"wrong\r\n")
        assert script.expect(b"\r\ninvalid password\r\n") == STARS * 5 + b"\r\n\r\ninvalid password\r\n"
    assert time.monotonic() - begun_s >= 0.25 + 0.5 + 1.0
    script.expect(b"password: ")
    script.send(PASSWORD + b"\r\n")
    script.expect(b"rtkrcv> ")
    script.close()
    assert server.counters["wrong_passwords"] == 3
    until(lambda: consoles.codes().count("telnet_refused") == 3)
    assert not any("wrong\r" in event.text or PASSWORD.decode() in str(event.data) for event in consoles.events)


def test_guessers_are_locked_out_for_a_while():
    """Pauses double up to a bound; many wrong ones lock an address out; its memory is bounded and fades."""
    throttle = Throttle()
    pauses = [throttle.wrong("a", 0.0) for _ in range(LOCKED_AFTER)]
    assert pauses[:5] == [0.25, 0.5, 1.0, 2.0, 4.0]
    assert max(pauses) == 4.0
    assert throttle.locked("a", 1.0)
    assert not throttle.locked("b", 1.0)
    assert not throttle.locked("a", MEMORY_S + 1.0)
    assert throttle.wrong("a", MEMORY_S + 1.0) == 0.25
    throttle.right("a")
    assert throttle.wrong("a", MEMORY_S + 2.0) == 0.25
    for number in range(2 * MAXIMUM_ADDRESSES):
        throttle.wrong(str(number), MEMORY_S)
    assert len(throttle._guessers) == MAXIMUM_ADDRESSES


@pytest.mark.e2e
def test_too_many_clients_are_turned_away(consoles: Consoles):
    """The limit is of all that are connected, logged in or not; a place that is free again is given."""
    server = consoles.open(maximum_clients=2)
    first, second = OldScript(server.port), OldScript(server.port)
    first.log_in()
    second.expect(b"password: ")
    third = OldScript(server.port)
    assert b"too many consoles" in third.to_the_end()
    first.send(b"exit\r\n")
    first.to_the_end()
    until(lambda: server.clients == 1)
    fourth = OldScript(server.port)
    fourth.log_in()
    for script in (second, third, fourth):
        script.close()


@pytest.mark.e2e
def test_who_says_nothing_is_logged_out(consoles: Consoles):
    """After the idle time, with a word of farewell."""
    script = OldScript(consoles.open(idle_s=1.5).port)
    script.log_in()
    assert script.to_the_end() == b"\r\nidle for too long: logged out\r\n"


@pytest.mark.e2e
def test_a_client_that_does_not_read_holds_up_nobody(solver: Solver, consoles: Consoles):
    """Megabytes for one who does not take them, and the others are served meanwhile; the end of the console waits for none."""
    server = consoles.open()
    deaf, other = OldScript(server.port), OldScript(server.port)
    deaf.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    deaf.log_in()
    other.log_in()
    deaf.send(b"stream\r\n" * 50)
    for _ in range(5):
        assert other.ask(b"so\r\n")
    begun_s = time.monotonic()
    server.close()
    assert time.monotonic() - begun_s < 15.0, "the end of the console waits for none that does not read"
    deaf.close()
    other.close()


@pytest.mark.e2e
def test_an_absent_solver_is_said(consoles: Consoles):
    """The console stays, and says who is not there."""
    script = OldScript(consoles.open(solver="gone", password="").port)
    script.expect(b"rtkrcv> ")
    until(lambda: b"no process 'gone'" in script.ask(b"status\r\n"))  # a hub that stands still says nothing of it
    assert script.ask(b"\r\n") == b"\r\n"
    script.close()


@pytest.mark.e2e
def test_random_bytes_leave_the_console_in_order(consoles: Consoles):
    """Clients that send anything and leave at any time: the next one is served."""
    server = consoles.open(password="", solver="gone")
    random = Random(7)
    for _ in range(30):
        script = OldScript(server.port)
        script.send(
            random.randbytes(200).replace(b"\r", b"").replace(b"\n", b"") + random.choice([b"", b"\r", b"\x03\x04", b"\xff\xfa\x18"])
        )
        script.close()
    until(lambda: server.clients == 0)
    script = OldScript(server.port)
    script.expect(b"rtkrcv> ")
    script.close()
    assert "internal" not in str([event.text for event in consoles.events])


@pytest.mark.e2e
def test_a_port_in_use_is_told_and_tried_again(consoles: Consoles, free_port: Callable[[], int]):
    """One console that cannot listen stops nothing; it begins when the port is free; a changed table restarts that one only."""
    servers = TelnetServers(consoles.context)
    port, other = free_port(), free_port()
    tables = {"a": TelnetTable(solver="rtk", listen=f"127.0.0.1:{port}"), "b": TelnetTable(solver="rtk", listen=f"127.0.0.1:{other}")}
    with socket.create_server(("127.0.0.1", port)):
        servers.apply(tables)
        assert (len(servers.faults), listens(other)) == (1, True)
        servers.try_again()
        assert len(servers.faults) == 1
    servers.try_again()
    assert (servers.faults, listens(port)) == ([], True)
    kept = OldScript(port)
    kept.expect(b"rtkrcv> ")
    servers.apply({"a": tables["a"]})
    assert not listens(other)
    assert kept.ask(b"\r\n") == b"\r\n"
    assert servers.counters()["telnet_clients"] == 1
    servers.close()
    assert not listens(port)
    kept.close()
    until(lambda: consoles.codes().count("telnet_failed") == 1)


@pytest.mark.parametrize(("sent", "echo"), ECHOES)
def test_echoes_are_rtkrcv_s(sent: bytes, echo: bytes):
    """Byte for byte as recorded, and in whatever pieces they come."""
    assert LineEditor().feed(sent)[0] == echo
    editor = LineEditor()
    assert b"".join(editor.feed(bytes((byte,)))[0] for byte in sent) == echo


def test_lines_passwords_and_earlier_lines():
    """LF alone ends a line too; passwords are stars and not in the history; arrows recall."""
    editor = LineEditor()
    editor.masked = True
    assert editor.feed(b"ab\x7fc\r\n") == (b"* \x08* \x08\x08 \x08* \x08\r\n", [Said(Kind.LINE, "ac")])
    editor.masked = False
    assert editor.feed(b"one\ntwo\r\n\n")[1] == [Said(Kind.LINE, text) for text in ("one", "two", "")]
    assert editor.feed(b"x\x1b[A\x1b[A\r")[1] == [Said(Kind.LINE, "one")]
    assert editor.feed(b"\x1bOA\x1b[A\x1b[B\x1b[B\r")[1] == [Said(Kind.LINE, "")]
    assert editor.feed(b"\x1b[1;5C\x1b[3~a\r")[1] == [Said(Kind.LINE, "a")]
    assert editor.feed(b"\xff\xf4\xff\xfa\x18\x01\x02\xff\xf0\xff\xf1b\r")[1] == [Said(Kind.BREAK), Said(Kind.LINE, "b")]
    assert editor.feed(b"x" * (MAXIMUM_LINE + 1) + b"\r")[1][0].kind is Kind.TOO_LONG
    assert editor.feed(b"\xff\xfd\x22\xff\xfb\x1f")[0] == b"\xff\xfc\x22\xff\xfe\x1f"


@given(st.binary(max_size=300), st.lists(st.integers(0, 300), max_size=5))
def test_any_bytes_in_any_pieces_say_the_same(data: bytes, cuts: list[int]):
    """What comes out does not hang on how TCP cuts it, is bounded, and is plain text."""
    whole = LineEditor().feed(data)
    editor, echo, said = LineEditor(), b"", list[Said]()
    for begin, end in zip([0, *sorted(cuts)], [*sorted(cuts), len(data)], strict=True):
        more = editor.feed(data[begin:end])
        echo, said = echo + more[0], said + more[1]
    assert (echo, said) == whole
    assert all(one.text.isascii() and len(one.text) <= MAXIMUM_LINE and (one.text.isprintable() or not one.text) for one in said)


def test_replies_are_harmless_on_a_terminal():
    """What receivers and casters said may be in a reply: a terminal must not obey it."""
    reply = Reply(ok=True, code=Code.OK, text="head\n\x1b]0;evil\x07 a\r\nb\n")
    assert shown("status", reply) == b"\r\n\x1b[1mhead\x1b[0m\r\n?]0;evil? a\r\nb\r\n"
    assert shown("set", Reply(ok=False, code=Code.FAILED, message="no\x1b[2J")) == b"no?[2J\r\n"
    assert shown("stop", done("rtk server stop")) == b"rtk server stop\r\n"
    assert shown("stream", accepted("x", rows=[1])).splitlines()[-1] == b"rows                        : [1]"
    assert wire("") == b""


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ('solver = "rtkk"', "no [solver.rtkk]; did you mean 'rtk'?"),
        ('solver = "rtk"\nlisten = "0.0.0.0:8023"', "needs a password"),
        ('solver = "rtk"\nlisten = "8023"', "is no HOST:PORT"),
        ('solver = "rtk"\npassword = "ü"', "ASCII"),
        ('solver = "rtk"\npasswort = "x"', "did you mean 'password'?"),
        ('solver = "rtk"\n[telnet.b]\nsolver = "rtk"', "is that of [telnet.a]"),
        ('solver = "rtk"\nmaximum_clients = 33', "maximum_clients"),
    ],
)
def test_faults_of_the_table_are_named(table: str, words: str):
    """With line, key and the nearest right name."""
    text = f'[ingest.a]\nsource = "tcp://h:1"\n[solver.rtk]\nrover = "a"\nmode = "single"\n[telnet.a]\n{table}\n'
    with pytest.raises(ConfigError) as caught:
        parse_deployment(text, "site.toml")
    assert words in str(caught.value)
    assert str(caught.value).startswith("site.toml:")


def test_a_password_opens_the_console_to_others(monkeypatch: pytest.MonkeyPatch):
    """From the environment, as all secrets; without a table there is no console."""
    monkeypatch.setenv("RTKMESH_TELNET_PASSWORD", "secret")
    site = '[ingest.a]\nsource = "tcp://h:1"\n[solver.rtk]\nrover = "a"\nmode = "single"\n'
    more = '[telnet.a]\nsolver = "rtk"\nlisten = "0.0.0.0:8023"\npassword = "${RTKMESH_TELNET_PASSWORD}"\n'
    assert parse_deployment(site + more, "site.toml").telnet["a"].password == "secret"
    assert parse_deployment(site, "site.toml").telnet == {}
