"""The console: what a line does, what completes it, how a terminal and a script use it."""

import json
import os
import pty
import select
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.patience import PATIENCE_S
from tests.services.told_solver import SITE, Solver, Told

from rtkmesh_schemas.keys import Role
from rtkmesh_services.cli.console_shell import CLEAR, Shell, candidates
from rtkmesh_services.runtime.clock import ManualClock
from rtkmesh_services.runtime.console_words import RTKRCV_WORDS, Typed, WordError, match_word, typed_line
from rtkmesh_services.runtime.lifecycle import Lifecycle
from rtkmesh_services.runtime.memory_bus import MemoryBus, MemoryNetwork
from rtkmesh_services.runtime.service import Context

# The pty is made the controlling terminal, so that Ctrl-C is a signal.
_ON_TERMINAL = "import fcntl, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0); from rtkmesh_services.cli.main import main; main()"


class World:
    """A solver on a network in memory, and a shell that speaks to it."""

    def __init__(self, **fields: Any) -> None:
        self.network = MemoryNetwork(ManualClock())
        self.bus = MemoryBus("rtk", self.network)
        self.service = Told(Context(id="rtk", role=Role.SOLVER, deployment=SITE, bus=self.bus, clock=self.network.clock))
        self.life = Lifecycle(self.service, warm_in_thread=False)
        self.life.start()
        self.life.step(0.0)
        self.network.on_wait = lambda: self.life.step(0.0)
        self.said, self.complained = list[str](), list[str]()
        self.shell = Shell(MemoryBus("me", self.network), write=self.said.append, complain=self.complained.append, timeout_s=0.2, **fields)

    def say(self, line: str) -> str:
        self.said.clear()
        self.complained.clear()
        self.shell.obey(line)
        return "".join(self.said)


@pytest.fixture
def world() -> World:
    world = World()
    world.shell.begin()
    return world


def test_the_only_solver_is_spoken_to(world: World):
    """Its text is shown as it is; without text the message and the data."""
    assert (world.shell.id, world.shell.worst) == ("rtk", 0)
    assert world.say("status").startswith("Parameter                   : Value\nrtklib version")
    assert world.say("set pos1-elmask 20") == "rtk: set done [RUNNING]\n"
    assert world.service.asked[-1].args == {"key": "pos1-elmask", "value": 20}
    assert "table:" in world.say("config")


def test_who_is_meant_is_said_when_it_is_not_clear(world: World):
    """Several solvers, or none: told, and the console waits for `use`."""
    world.shell.bus.live_token("solver", "rtk2")
    other = Shell(world.shell.bus, complain=world.complained.append)
    other.begin()
    assert (other.id, other.worst) == ("", 2)
    assert world.complained == ["there are several solvers: say use ID, one of rtk, rtk2\n"]
    other.obey("help")
    other.obey("status")
    assert other.worst == 2
    empty = Shell(MemoryBus("me"), complain=world.complained.append)
    empty.begin()
    assert "no solver is on the network" in world.complained[-1]
    assert empty.worst == 3


@pytest.mark.parametrize(
    ("line", "words", "code"),
    [
        ("sat", "", 0),
        ("so", "", 0),
        ("SOLUTION", "", 0),
        ("st", "ambiguous command: st. (start, status, stream)", 2),
        ("nonsense", "unknown command: nonsense.", 2),
        ("statsu", "did you mean 'status'?", 2),
        ("shut", "unknown command: shut.", 2),
        ("!ls", "no shell commands here", 2),
        ("set 'a", "quotation", 2),
        ("load a b", "'b' is no argument of load", 2),
        ("start", "rtk server already started", 1),
        ("use gone", "no process 'gone'", 3),
        ("use Gone!", "is no id", 2),
        ("events maybe", "events on or events off", 2),
        ("help statsu", "did you mean 'status'?", 2),
    ],
)
def test_lines_and_what_is_said_of_wrong_ones(world: World, line: str, words: str, code: int):
    """Whatever is wrong is told, the exit code is the worst, and the console goes on."""
    world.say(line)
    assert words.lower() in "".join(world.complained).lower()
    assert (world.shell.worst, world.shell.ended) == (code, False)
    world.say("use rtk")
    assert world.say("so").startswith("2026/11/26")
    assert world.shell.worst == code


def test_a_process_that_hangs_is_told_and_the_console_stays(world: World):
    """And when it answers again, so it does."""
    step, world.network.on_wait = world.network.on_wait, lambda: None
    world.say("so")
    assert "hang" in "".join(world.complained)
    assert world.shell.worst == 124
    world.network.on_wait = step
    for _ in range(10):
        world.life.step(0.0)
    assert world.say("so").startswith("2026/11/26")


def test_a_cycle_shows_the_screen_again_and_again():
    """With the pause that was said, until the wait says so; the console goes on."""
    pauses = list[float]()

    def wait(seconds: float) -> bool:
        pauses.append(seconds)
        return len(pauses) in {3, 5}

    world = World(pauses=lambda: nullcontext(wait), ansi=True)
    world.shell.begin()
    assert world.say("status 2").count(CLEAR + "") == 3
    assert pauses == [2.0] * 3
    assert world.say("sat 0.5").count(CLEAR) == 2
    assert pauses[3:] == [0.5] * 2
    assert (world.shell.worst, world.shell.ended) == (0, False)
    assert len(world.service.asked) == 5


def test_events_are_shown_when_asked_for(world: World):
    """Of the process that is spoken to, until they are switched off."""
    assert "asked" not in world.say("so")
    world.say("events on")
    assert "[info] rtk asked: was asked for solution\n" in world.say("so")
    assert "[info] rtk command: command set from " in world.say("set a 1")
    world.say("events off")
    assert "asked" not in world.say("so")


def test_json_is_one_line_a_reply():
    """For programs: replies as on the wire."""
    world = World(as_json=True)
    world.shell.begin()
    reply = json.loads(world.say("so"))
    assert (reply["ok"], reply["id"], reply["text"][:4]) == (True, "rtk", "2026")
    assert json.loads(world.say("start"))["code"] == "wrong_state"
    assert json.loads(world.say("processes")) == {"rtk": "solver"}
    assert "exit" in json.loads(world.say("help"))


def test_help_and_the_end(world: World):
    """The process's words and the console's own."""
    page = world.say("help")
    assert {line.split()[0] for line in page.splitlines()} >= {"status", "satellite", "use", "exit"}
    assert world.say("help exit") == world.say("? exit") == "exit               end the console (also Ctrl-D)\n"
    assert world.say("processes") == "* rtk                  solver\n"
    world.say("# a comment")
    world.say("   ")
    assert not world.shell.ended
    world.say("exit")
    assert (world.shell.ended, world.shell.worst) == (True, 0)


@pytest.mark.parametrize(
    ("before", "expected"),
    [
        ("sat", ["satellite"]),
        ("st", ["start", "status", "stream"]),
        ("shut", []),
        ("set ele", ["elevation_mask_deg"]),
        ("option ambiguity.ra", ["ambiguity.ratio"]),
        ("set elevation_mask_deg 1", []),
        ("load n", ["night.toml"]),
        ("use r", ["rtk"]),
        ("events o", ["off", "on"]),
        ("help sol", ["solution"]),
        ("solution x", []),
    ],
)
def test_completions(world: World, before: str, expected: list[str]):
    """Words, names of options, files, ids; nothing where nothing fits."""
    assert candidates(world.shell, before, lambda: ["night.toml", "other.conf"]) == expected


@pytest.mark.parametrize(
    ("line", "typed"),
    [
        ("status 2", Typed("status", {}, 2.0)),
        ("status 0", Typed("status", {}, 0.0)),
        ("satellite -2 .5", Typed("satellite", {"frequencies": 2}, 0.5)),
        ("navidata -p1 -n2", Typed("navidata")),
        ("so 1e9", Typed("solution", {}, 3600.0)),
        ("so 0.0001", Typed("solution", {}, 0.1)),
        ("set a 5", Typed("set", {"key": "a", "value": 5})),
        ("opt pos1", Typed("option", {"pattern": "pos1"})),
        ("mark A note", Typed("mark", {"name": "A", "comment": "note"})),
        ("? status", Typed("help", {"word": "status"})),
        ("shutdown", Typed("shutdown")),
    ],
)
def test_lines_are_understood(line: str, typed: Typed):
    """As RTKRCV's users type them."""
    assert typed_line(line.split(), RTKRCV_WORDS) == typed


@given(st.text(max_size=12))
def test_a_prefix_never_stands_for_a_word_that_others_share(prefix: str):
    """Nothing, one word that begins so, or all of them; shutdown only in full."""
    found = match_word(prefix, RTKRCV_WORDS)
    beginning = [word for word in RTKRCV_WORDS if prefix and word.startswith(prefix.lower().replace("-", "_"))]
    assert "shutdown" not in found or prefix.lower() == "shutdown"
    assert prefix.lower() in RTKRCV_WORDS or set(found) == set(beginning) - {"shutdown"}


@given(st.lists(st.text(min_size=1, max_size=10), min_size=1, max_size=5))
def test_any_words_are_understood_or_refused(words: list[str]):
    """No line raises anything else."""
    try:
        typed = typed_line([["set", "status", "load", "so"][len(words) % 4], *words[1:]], RTKRCV_WORDS)
    except WordError:
        return
    assert typed.cycle_s == 0.0 or 0.1 <= typed.cycle_s <= 3600.0


class Terminal:
    """`rtkmesh console` on a pty."""

    def __init__(self, *arguments: str, state: Path) -> None:
        self.screen = ""
        self._ours, theirs = pty.openpty()
        command = [sys.executable, "-c", _ON_TERMINAL, "console", *arguments]
        environment = {**os.environ, "RTKMESH_STATE": str(state), "TERM": "xterm", "INPUTRC": "/dev/null"}
        self.process = subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=theirs, env=environment, start_new_session=True)
        os.close(theirs)

    def type(self, text: str) -> None:
        os.write(self._ours, text.encode())

    def expect(self, mark: str) -> str:
        """Return what the screen gets up to the mark."""
        deadline_s = time.monotonic() + PATIENCE_S
        while mark not in self.screen:
            written = select.select([self._ours], [], [], max(deadline_s - time.monotonic(), 0.0))[0]
            assert written, f"no {mark!r}: {self.screen!r}"
            self.screen += os.read(self._ours, 65536).decode(errors="replace")
        found, _, self.screen = self.screen.partition(mark)
        return found + mark

    def interrupt(self, mark: str) -> None:
        """Press Ctrl-C until the mark comes: Python's prompt does not see one that comes between a key and its wait for the next."""
        deadline_s = time.monotonic() + PATIENCE_S
        while mark not in self.screen:
            assert time.monotonic() < deadline_s, f"no {mark!r}: {self.screen!r}"
            self.type("\x03")
            while mark not in self.screen and select.select([self._ours], [], [], 2.0)[0]:
                self.screen += os.read(self._ours, 65536).decode(errors="replace")
        self.expect(mark)

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        os.close(self._ours)


@pytest.fixture
def terminal(tmp_path: Path) -> Iterator[Callable[..., Terminal]]:
    """A function that starts a console on a terminal; all are ended after the test."""
    made: list[Terminal] = []

    def start(*arguments: str) -> Terminal:
        made.append(Terminal(*arguments, state=tmp_path / "state"))
        return made[-1]

    yield start
    for one in made:
        one.close()


@pytest.mark.e2e
def test_a_terminal_with_completion_cycles_and_history(site: Any, solver: Solver, terminal: Callable[..., Terminal], tmp_path: Path):
    """Tab completes, Ctrl-C ends the cycle and not the console, Enter too; secrets are not kept, the rest is there the next time."""
    first = terminal("--connect", site.endpoint)
    first.expect("rtk> ")
    first.type("sat\t\r")
    first.expect("SAT C1    Az   El")
    first.expect("rtk> ")
    first.type("status 0.2\r")
    for _ in range(2):
        first.expect(CLEAR)
    first.type("\x03")
    first.expect("rtk> ")
    first.type("status 0.2\r")
    first.expect(CLEAR)
    first.type("\r")
    first.expect("rtk> ")
    first.type("half a line")
    first.expect("half a line")
    first.interrupt("rtk> ")
    first.type("set console-passwd hunter2\r")
    first.expect("set done")
    first.expect("rtk> ")
    first.type("so\r")
    first.expect("(FIX  )")
    first.expect("rtk> ")
    first.type("\x04")
    assert first.process.wait(PATIENCE_S) == 0
    history = tmp_path / "state" / "console_history"
    assert history.read_text().splitlines()[-1] == "so"
    assert "hunter2" not in history.read_text()
    assert history.stat().st_mode & 0o077 == 0
    second = terminal("--connect", site.endpoint)
    second.expect("rtk> ")
    second.type("\x1b[A\r")
    second.expect("(FIX  )")
    second.type("exit\r")
    assert second.process.wait(PATIENCE_S) == 0


@pytest.mark.e2e
def test_a_script_by_pipe(site: Any, solver: Solver):
    """Lines in, answers out, the worst exit code; a cycle is shown once."""
    command = [sys.executable, "-m", "rtkmesh_services.cli.main", "console", "rtk", "--connect", site.endpoint]
    lines = "# morning\nstatus 5\nset a 1\n\nstart\nexit\nset b 2\n"
    result = subprocess.run(command, input=lines, capture_output=True, text=True, check=False, timeout=60)
    assert (result.returncode, result.stderr) == (1, "rtk: wrong_state: rtk server already started [RUNNING]\n")
    assert result.stdout.count("rtklib version") == 1
    assert result.stdout.endswith("rtk: set done [RUNNING]\n")
    assert [request.op for request in solver.service.asked] == ["status", "set", "start"]
    rows = subprocess.run([*command, "--json"], input="so\nhelp\n", capture_output=True, text=True, check=False, timeout=60)
    assert rows.returncode == 0
    assert [sorted(json.loads(line))[:1] for line in rows.stdout.splitlines()] == [["code"], ["config"]]
    gone = subprocess.run(
        [*command[:4], "gone", "--timeout", "2", *command[5:]], input="", capture_output=True, text=True, check=False, timeout=60
    )
    assert (gone.returncode, "no process 'gone'" in gone.stderr) == (3, True)
