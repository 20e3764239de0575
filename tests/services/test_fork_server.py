"""The fork server as a real process: what it forks is like a program that we started, and without it everything goes on."""

import ctypes
import os
import selectors
import signal
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from tests.patience import until

from rtkmesh_schemas.keys import Role
from rtkmesh_services.control.fleet import ProcessSpec, clean_environment
from rtkmesh_services.control.forking import PATIENCE_S, RETRY_S, ForkServer
from rtkmesh_services.control.output import OutputLine
from rtkmesh_services.control.process import Child, start_program

PR_SET_CHILD_SUBREAPER = 36
COMMAND = (sys.executable, "-m", "rtkmesh_services.cli.main")
ENVIRONMENT = clean_environment(os.environ, Role.ATTITUDE)
KEYS = ProcessSpec("keys", Role.ATTITUDE, (*COMMAND, "keys"), ENVIRONMENT | {"COLUMNS": "300"})

DEPLOYMENT = """
[hub]
listen = ["tcp/127.0.0.1:1"]
[ingest.rover]
source = "tcp://127.0.0.1:2"
[solver.rtk]
rover = "rover"
mode = "single"
[attitude.heading]
solver = "rtk"
"""


class Server:
    """A fork server and what its keeper does with it."""

    def __init__(self) -> None:
        self.server, self.selector = ForkServer((Role.ATTITUDE,), ENVIRONMENT), selectors.DefaultSelector()
        self.now_s = 0.0
        self.lines: list[OutputLine] = []

    def tend(self) -> None:
        self.server.tend(self.now_s, self.selector)

    def ready(self) -> None:
        """Wait until it forks."""
        self.tend()
        until(lambda: bool(self.server.ready), step=lambda: self.selector.select(0.1) and self.server.read())

    def held(self) -> frozenset[Role]:
        return self.server.held(self.now_s)

    def child(self, spec: ProcessSpec) -> Child:
        return Child(spec, self.lines.append, lambda spec: self.server.start(spec) or start_program(spec))

    def pid(self) -> int:
        """The server's process: our child with its title."""
        return next(pid for pid in children() if command_line(pid) == "rtkmesh fork server")


@pytest.fixture
def server() -> Iterator[Server]:
    made = Server()
    yield made
    made.server.close()
    made.selector.close()
    ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 0, 0, 0, 0)
    assert not children(), "nothing is left"


def children() -> list[int]:
    return [int(pid) for pid in Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()]


def command_line(pid: int) -> str:
    return Path(f"/proc/{pid}/cmdline").read_bytes().rstrip(b"\0").decode()


def ended(child: Child) -> int:
    """Read its output until it has ended; return its exit code."""
    codes: list[int] = []

    def step() -> None:
        with selectors.DefaultSelector() as selector:
            for descriptor in child.descriptors():
                selector.register(descriptor, selectors.EVENT_READ)
            for key, _ in selector.select(1.0):
                if key.fd != child.exit_descriptor:
                    child.read(key.fd)
        if (code := child.reap()) is not None:
            codes.append(code)

    until(lambda: bool(codes), step=step)
    return codes[0]


def text_of(server: Server) -> list[str]:
    return [line.text for line in server.lines]


def test_a_forked_process_says_what_the_program_says_and_ends_with_its_code(server: Server) -> None:
    """Output, error output and exit code of a process are the same forked and as a program."""
    wrong = replace(KEYS, argv=(*COMMAND, "keys", "--no-such"))
    said: dict[str, list[object]] = {}
    for how in ("program", "forked"):
        if how == "forked":
            server.ready()
        codes = [ended(server.child(KEYS)), ended(server.child(wrong))]
        said[how] = [codes, *text_of(server)]
        server.lines.clear()
    assert said["forked"] == said["program"]
    assert said["forked"][0] == [0, 2]
    assert any("rtk/{id}/sol" in str(line) for line in said["forked"])


def test_a_forked_process_is_our_child_in_a_session_and_environment_of_its_own(server: Server, tmp_path: Path) -> None:
    """It is adopted before its pid is told, has the title of its command, and a signal's number as exit code."""
    file = tmp_path / "robot.toml"
    file.write_text(DEPLOYMENT)
    server.ready()
    arguments = ("run", "attitude", "--id", "heading", "--config", str(file))
    child = server.child(ProcessSpec("heading", Role.ATTITUDE, (*COMMAND, *arguments), ENVIRONMENT | {"RTKMESH_MARK": "here"}))
    assert child.pid in children()
    until(lambda: "RTKMESH_MARK" not in os.environ and os.getsid(child.pid) == child.pid, step=lambda: time.sleep(0.01))
    until(lambda: command_line(child.pid) == f"rtkmesh {' '.join(arguments)}", step=lambda: time.sleep(0.01))
    child.signal(signal.SIGKILL)
    assert ended(child) == -signal.SIGKILL


def test_processes_are_held_until_it_is_ready_but_not_for_ever(server: Server) -> None:
    """A first start that compiles must not keep the fleet waiting."""
    server.tend()
    assert server.held() == {Role.ATTITUDE}
    server.now_s = PATIENCE_S + 0.1
    assert not server.held()


def test_without_it_programs_are_started_and_later_it_is_back(server: Server) -> None:
    """A killed fork server costs nothing but speed; its children live."""
    server.ready()
    os.kill(server.pid(), signal.SIGKILL)
    assert ended(server.child(KEYS)) == 0
    server.tend()
    assert not server.held()
    assert not children(), "not at once again"
    server.now_s = RETRY_S + 0.1
    server.ready()
    assert server.pid()
    assert ended(server.child(KEYS)) == 0
