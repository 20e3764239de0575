"""The decisions of the supervisor, with a clock of our own; and the keeper with real, tiny processes."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.patience import PATIENCE_S, until

from rtkmesh_schemas.config import ControlTable
from rtkmesh_schemas.keys import Role
from rtkmesh_services.control.endpoints import accepts, is_free, tcp_address
from rtkmesh_services.control.fleet import ProcessSpec
from rtkmesh_services.control.keeper import Keeper
from rtkmesh_services.control.output import OutputLine, parse_line
from rtkmesh_services.control.records import Action, ProcessState, Verb
from rtkmesh_services.control.supervisor import Supervisor

LIMITS = ControlTable()
HUB = ProcessSpec("hub", Role.HUB, ("hub",))
ROVER = ProcessSpec("rover", Role.INGEST, ("rover",))
RTK = ProcessSpec("rtk", Role.SOLVER, ("rtk",))


class Fleet:
    """A supervisor whose actions are carried out at once by an imaginary operating system."""

    def __init__(self, *specs: ProcessSpec, limits: ControlTable = LIMITS, ready: bool = True) -> None:
        self.now_s, self.pid, self.supervisor = 1000.0, 100, Supervisor(limits)
        self.done: list[Action] = []
        for spec in specs:
            self.supervisor.add(spec)
        if ready:
            self.supervisor.hub_ready()
        self.run()

    def run(self, seconds: float = 0.0, beat: tuple[str, ...] = (), step_s: float = 0.1) -> list[Action]:
        """Let time pass; ``beat`` are the processes whose work loops are alive. Return what was done."""
        done: list[Action] = []
        for _ in range(max(1, round(seconds / step_s))):
            self.now_s += step_s if seconds else 0.0
            for id_ in beat:
                if (record := self.supervisor.record(id_)) and record.alive:
                    self.supervisor.heartbeat(id_, record.pid, self.now_s)
            for action in self.supervisor.actions(self.now_s):
                done.append(action)
                if action.verb is Verb.SPAWN:
                    self.pid += 1
                    self.supervisor.spawned(action.id, self.pid, self.now_s)
        self.done += done
        return done

    def die(self, id_: str, code: int = 1, line: str = "boom") -> None:
        self.supervisor.exited(id_, code, line, self.now_s)

    def row(self, id_: str) -> dict[str, object]:
        return next(row for row in self.supervisor.rows(self.now_s) if row["id"] == id_)


def spawns(actions: list[Action]) -> list[str]:
    return [action.id for action in actions if action.verb is Verb.SPAWN]


def test_hub_starts_first_and_the_others_at_once_when_it_takes_connections() -> None:
    fleet = Fleet(HUB, ROVER, RTK, ready=False)
    assert spawns(fleet.done) == ["hub"]
    assert spawns(fleet.run(1.0)) == []
    fleet.supervisor.hub_ready()
    assert spawns(fleet.run()) == ["rover", "rtk"]


def test_first_heartbeat_makes_it_running_and_one_of_another_pid_does_not() -> None:
    fleet = Fleet(ROVER)
    fleet.supervisor.heartbeat("rover", 99999, fleet.now_s)
    assert fleet.row("rover")["state"] == "STARTING"
    fleet.run(0.1, beat=("rover",))
    assert fleet.row("rover")["state"] == "RUNNING"


def test_a_process_that_is_included_again_while_it_ends_comes_back_with_its_new_definition() -> None:
    fleet = Fleet(HUB, ROVER)
    base = ProcessSpec("base_near", Role.INGEST, ("near",))
    fleet.supervisor.include(base, fleet.now_s)
    assert spawns(fleet.run()) == ["base_near"]
    fleet.supervisor.include(base, fleet.now_s)
    assert fleet.run(1.0) == []  # nothing has changed
    fleet.supervisor.remove("base_near", fleet.now_s)
    changed = ProcessSpec("base_near", Role.INGEST, ("other",))
    fleet.supervisor.include(changed, fleet.now_s)
    assert [action.verb for action in fleet.run()] == [Verb.TERMINATE]
    fleet.die("base_near", 0)
    assert spawns(fleet.run(0.2)) == ["base_near"]
    record = fleet.supervisor.record("base_near")
    assert record is not None
    assert record.spec == changed


def test_back_off_doubles_from_the_first_to_the_last_delay() -> None:
    limits = ControlTable(crash_limit=100, crash_window_s=1000.0)
    fleet = Fleet(ROVER, limits=limits)
    delays: list[float] = []
    for _ in range(8):
        died_s = fleet.now_s
        fleet.die("rover")
        while not spawns(fleet.run(0.05, step_s=0.05)):
            assert fleet.now_s - died_s < 10.0
        delays.append(fleet.now_s - died_s)
    assert delays == pytest.approx([0.2, 0.4, 0.8, 1.6, 3.2, 5.0, 5.0, 5.0], abs=0.06)


def test_fifth_death_within_a_minute_is_failed_with_the_last_line_while_others_run() -> None:
    fleet = Fleet(HUB, ROVER, RTK)
    for _ in range(4):
        fleet.die("rover", 70, "ZeroDivisionError: x")
        fleet.run(6.0, beat=("hub", "rtk", "rover"))
        assert fleet.row("rover")["state"] == "RUNNING"
    fleet.die("rover", 70, "ZeroDivisionError: x")
    assert spawns(fleet.run(120.0, beat=("hub", "rtk"))) == []
    assert fleet.row("rover")["state"] == "FAILED"
    assert fleet.row("rover")["reason"] == "5 deaths in 60 s; the last: exit code 70: ZeroDivisionError: x"
    assert fleet.row("rtk")["state"] == "RUNNING"
    assert fleet.row("rtk")["restarts"] == 0


def test_deaths_far_apart_never_fail_a_process() -> None:
    fleet = Fleet(HUB, ROVER)
    for _ in range(12):
        fleet.die("rover")
        fleet.run(20.0, beat=("hub", "rover"), step_s=0.5)
        assert fleet.row("rover")["state"] == "RUNNING"
    assert fleet.row("rover")["restarts"] == 12


def test_start_command_gives_a_failed_process_a_fresh_count() -> None:
    fleet = Fleet(ROVER)
    for _ in range(5):
        fleet.die("rover")
        fleet.run(6.0)
    assert fleet.row("rover")["state"] == "FAILED"
    fleet.supervisor.start("rover", fleet.now_s)
    assert spawns(fleet.run()) == ["rover"]
    fleet.die("rover")
    assert fleet.row("rover")["state"] == "WAITING"


def test_wrong_configuration_fails_at_once() -> None:
    fleet = Fleet(ROVER)
    fleet.die("rover", 2, "demo.toml:3: unknown key")
    assert fleet.row("rover")["state"] == "FAILED"
    assert "demo.toml:3" in str(fleet.row("rover")["reason"])


def test_process_that_ends_well_by_itself_is_wanted_still_and_comes_back() -> None:
    fleet = Fleet(ROVER)
    fleet.die("rover", 0, "")
    assert fleet.row("rover")["reason"] == "it ended by itself (exit code 0)"
    assert spawns(fleet.run(0.3)) == ["rover"]


def test_stopped_process_gets_term_then_kill_after_the_grace_time_and_stays_down() -> None:
    fleet = Fleet(HUB, ROVER)
    fleet.supervisor.stop("rover", fleet.now_s)
    assert fleet.run(1.9) == [Action(Verb.TERMINATE, "rover")]
    assert fleet.run(0.3) == [Action(Verb.KILL, "rover")]
    assert fleet.run(5.0, beat=("hub",)) == []
    fleet.die("rover", -9, "")
    assert spawns(fleet.run(60.0, beat=("hub",), step_s=0.5)) == []
    assert fleet.row("rover")["state"] == "STOPPED"


def test_restart_command_stops_then_starts_and_is_no_death() -> None:
    fleet = Fleet(ROVER)
    fleet.supervisor.restart("rover", fleet.now_s)
    assert fleet.run(0.1) == [Action(Verb.TERMINATE, "rover")]
    fleet.die("rover", 0, "")
    assert spawns(fleet.run()) == ["rover"]
    record = fleet.supervisor.record("rover")
    assert record is not None
    assert len(record.deaths_s) == 0
    assert record.restarts == 1


def test_start_during_stopping_starts_again() -> None:
    fleet = Fleet(ROVER)
    fleet.supervisor.stop("rover", fleet.now_s)
    fleet.run(0.1)
    fleet.supervisor.start("rover", fleet.now_s)
    fleet.die("rover", 0, "")
    assert spawns(fleet.run()) == ["rover"]


def test_silent_work_loop_is_killed_and_replaced_while_the_hub_is_heard() -> None:
    fleet = Fleet(HUB, ROVER, RTK)
    fleet.run(10.0, beat=("hub", "rover", "rtk"))
    assert fleet.run(4.8, beat=("hub", "rover")) == []
    assert fleet.run(0.5, beat=("hub", "rover")) == [Action(Verb.KILL, "rtk")]
    assert fleet.run(1.0, beat=("hub", "rover")) == []
    fleet.die("rtk", -9, "")
    assert "hung: no heartbeat for 5" in str(fleet.row("rtk")["reason"])
    assert spawns(fleet.run(0.3, beat=("hub", "rover"))) == ["rtk"]


def test_without_the_hub_nobody_is_heard_and_nobody_is_killed_for_it() -> None:
    fleet = Fleet(HUB, ROVER, RTK)
    fleet.run(10.0, beat=("hub", "rover", "rtk"))
    fleet.die("hub", -9, "")
    done = fleet.run(8.0)
    assert [action for action in done if action.id != "hub"] == []
    done = fleet.run(4.0, beat=("hub",))  # it is back; the others have a whole timeout to be heard again
    assert done == []


def test_hung_hub_is_replaced_alone() -> None:
    fleet = Fleet(HUB, ROVER)
    fleet.run(10.0, beat=("hub", "rover"))
    assert fleet.run(20.0) == [Action(Verb.KILL, "hub")]


def test_a_control_that_stood_still_kills_nobody_for_it() -> None:
    """The machine sleeps, or control is stopped: nobody was heard meanwhile, nobody had time to end. Who is silent later is hung."""
    fleet = Fleet(HUB, ROVER, RTK)
    fleet.run(10.0, beat=("hub", "rover", "rtk"))
    fleet.supervisor.stop("rtk", fleet.now_s)
    assert fleet.run() == [Action(Verb.TERMINATE, "rtk")]
    fleet.now_s += 8.0
    assert fleet.run() == []
    assert fleet.run(1.8, beat=("hub", "rover")) == []
    assert fleet.run(0.5, beat=("hub", "rover")) == [Action(Verb.KILL, "rtk")]
    assert fleet.run(20.0, beat=("rover",)) == [Action(Verb.KILL, "hub")]


def test_without_a_hub_of_ours_any_voice_is_the_reference() -> None:
    fleet = Fleet(ROVER, RTK)
    fleet.run(10.0, beat=("rover", "rtk"))
    assert fleet.run(30.0) == []
    fleet.run(10.0, beat=("rover", "rtk"))
    assert Action(Verb.KILL, "rtk") in fleet.run(12.0, beat=("rover",))


def test_process_that_never_beats_has_the_long_first_grace() -> None:
    fleet = Fleet(HUB, ROVER)
    assert fleet.run(29.0, beat=("hub",)) == []
    assert fleet.run(2.0, beat=("hub",)) == [Action(Verb.KILL, "rover")]


def test_end_stops_processes_first_and_the_hub_last() -> None:
    fleet = Fleet(HUB, ROVER, RTK)
    fleet.run(2.0, beat=("hub", "rover", "rtk"))
    fleet.supervisor.end(fleet.now_s)
    assert fleet.run(0.1) == [Action(Verb.TERMINATE, "rover"), Action(Verb.TERMINATE, "rtk")]
    fleet.die("rover", 0)
    assert fleet.run(0.1) == []
    fleet.die("rtk", 0)
    assert fleet.run(0.1) == [Action(Verb.TERMINATE, "hub")]
    assert not fleet.supervisor.ended
    fleet.die("hub", 0)
    assert fleet.supervisor.ended


@pytest.mark.parametrize("command", ["stop", "end"])
def test_process_that_is_started_while_it_is_stopped_does_not_stay(command: str) -> None:
    """The order to spawn was given before the command and carried out after it."""
    fleet = Fleet()
    fleet.supervisor.add(ROVER)
    assert fleet.supervisor.actions(fleet.now_s) == [Action(Verb.SPAWN, "rover")]
    getattr(fleet.supervisor, command)(*(["rover"] if command == "stop" else []), fleet.now_s)
    fleet.supervisor.spawned("rover", 7, fleet.now_s)
    assert fleet.run() == [Action(Verb.TERMINATE, "rover")]


def test_removed_process_is_forgotten_when_it_is_gone() -> None:
    fleet = Fleet(HUB, ROVER)
    fleet.supervisor.remove("rover", fleet.now_s)
    assert fleet.run() == [Action(Verb.TERMINATE, "rover")]
    fleet.die("rover", 0)
    assert fleet.supervisor.ids() == ["hub"]


EVENTS = st.lists(
    st.tuples(st.sampled_from(["die", "die0", "stop", "start", "restart", "beat", "wait"]), st.sampled_from(["hub", "rover", "rtk"])),
    max_size=40,
)


@settings(max_examples=60, deadline=None)
@given(EVENTS)
def test_any_history_ends_with_what_is_wanted(events: list[tuple[str, str]]) -> None:
    """Whatever happens: never two spawns without an end between them, and after ``end`` nothing is left."""
    fleet = Fleet(HUB, ROVER, RTK)
    for event, id_ in events:
        record = fleet.supervisor.record(id_)
        assert record is not None
        if event in ("die", "die0") and record.alive:
            fleet.die(id_, 0 if event == "die0" else 1)
        elif event in ("stop", "start", "restart"):
            getattr(fleet.supervisor, event)(id_, fleet.now_s)
        fleet.run(0.5, beat=("hub", "rover", "rtk") if event == "beat" else ())
        for action in fleet.done:
            if action.verb is Verb.KILL and (killed := fleet.supervisor.record(action.id)) and killed.alive and killed.killed:
                fleet.die(action.id, -9)
        assert record.alive == (record.state in (ProcessState.STARTING, ProcessState.RUNNING, ProcessState.STOPPING))
        assert not (record.state is ProcessState.STOPPED and record.wanted)
    fleet.supervisor.end(fleet.now_s)
    for _ in range(50):
        for id_ in ("hub", "rover", "rtk"):
            record = fleet.supervisor.record(id_)
            if record is not None and record.killed:
                fleet.die(id_, -9)
        assert spawns(fleet.run(0.5)) == []
    assert fleet.supervisor.ended


# -- the keeper with real processes

SLEEPER = "import time, sys; print('up', flush=True); time.sleep(600)"
STUBBORN = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('up', flush=True); time.sleep(600)"
CRASHER = "import sys; print('about to fail', file=sys.stderr); raise SystemExit(3)"
FAMILY = "import subprocess, sys, time; c = subprocess.Popen(['sleep', '600']); print(c.pid, flush=True); time.sleep(600)"


def script(id_: str, code: str) -> ProcessSpec:
    return ProcessSpec(id_, Role.INGEST, (sys.executable, "-S", "-E", "-c", code), {})


class Watched:
    """A keeper whose changes and lines can be waited for."""

    def __init__(self, *specs: ProcessSpec, limits: ControlTable = LIMITS) -> None:
        self.changed = threading.Condition()
        self.lines: list[OutputLine] = []
        self.ahead_s = 0.0
        self.keeper = Keeper(list(specs), limits, on_line=self._line, clock_s=self.clock_s)
        self.keeper.on_change(self._change)
        self.keeper.begin()

    def clock_s(self) -> float:
        return time.monotonic() + self.ahead_s

    def until(self, what: Callable[[], bool], timeout_s: float = PATIENCE_S) -> None:
        with self.changed:
            assert self.changed.wait_for(what, timeout_s), (self.keeper.rows(), self.lines)

    def row(self, id_: str) -> dict[str, object]:
        return next(row for row in self.keeper.rows() if row["id"] == id_)

    def said(self, id_: str, text: str, times: int = 1) -> bool:
        return sum(line.id == id_ and line.text == text for line in self.lines) >= times

    def _line(self, line: OutputLine) -> None:
        with self.changed:
            self.lines.append(line)
            self.changed.notify_all()

    def _change(self, _row: dict[str, object]) -> None:
        with self.changed:
            self.changed.notify_all()


@pytest.fixture
def watch() -> Iterator[Callable[..., Watched]]:
    made: list[Watched] = []

    def make(*specs: ProcessSpec, limits: ControlTable = LIMITS) -> Watched:
        made.append(Watched(*specs, limits=limits))
        return made[-1]

    yield make
    for watched in made:
        assert watched.keeper.end()


def exists(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def gone(pid: int, timeout_s: float = PATIENCE_S) -> bool:
    """Whether a process that is no child of ours ends in time (its entry may be a zombie of its new parent for a moment)."""
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        try:
            if Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z":
                return True
        except FileNotFoundError:
            return True
        time.sleep(0.01)  # polling a foreign process: nothing to wait on
    return False


def test_killed_process_is_replaced_within_half_a_second(watch: Callable[..., Watched]) -> None:
    """The others are left alone. Of several deaths one counts: the machine may stand still in others."""
    ids = ("a", "b", "c", "d")
    watched = watch(*(script(id_, SLEEPER) for id_ in ids))
    watched.until(lambda: all(watched.said(id_, "up") for id_ in ids))
    before = {id_: watched.row(id_)["pid"] for id_ in ids}
    took_s = [replaced_s(watched, id_) for id_ in ids[:3]]
    assert min(took_s) < 0.5
    assert watched.row("d")["pid"] == before["d"]
    assert [watched.row(id_)["restarts"] for id_ in ids] == [1, 1, 1, 0]


def replaced_s(watched: Watched, id_: str) -> float:
    """Kill a process and return how long it takes until there is another."""
    pid = watched.row(id_)["pid"]
    assert isinstance(pid, int)
    started = time.monotonic()
    os.kill(pid, signal.SIGKILL)
    watched.until(lambda: watched.row(id_)["pid"] not in (0, pid))
    return time.monotonic() - started


def test_crash_loop_fails_with_the_last_error_line(watch: Callable[..., Watched]) -> None:
    limits = ControlTable(backoff_first_s=0.01, crash_limit=3)
    watched = watch(script("a", CRASHER), limits=limits)
    watched.until(lambda: watched.row("a")["state"] == "FAILED")
    assert watched.row("a")["reason"] == "3 deaths in 60 s; the last: exit code 3: about to fail"
    assert watched.keeper.last_lines("a", 2) == ["about to fail", "about to fail"]


def test_process_that_ignores_term_is_killed_after_the_grace_time(watch: Callable[..., Watched]) -> None:
    watched = watch(script("a", STUBBORN), limits=ControlTable(term_grace_s=0.2))
    watched.until(lambda: watched.said("a", "up"))
    pid = watched.row("a")["pid"]
    watched.keeper.stop("a")
    watched.until(lambda: watched.row("a")["state"] == "STOPPED")
    assert isinstance(pid, int)
    assert not exists(pid)


def test_what_a_process_leaves_in_its_group_goes_with_it(watch: Callable[..., Watched]) -> None:
    watched = watch(script("a", FAMILY))
    watched.until(lambda: bool(watched.lines))
    grandchild, pid = int(watched.lines[0].text), watched.row("a")["pid"]
    assert isinstance(pid, int)
    os.kill(pid, signal.SIGKILL)
    assert gone(grandchild)


def test_silent_process_is_replaced_by_the_hang_watch(watch: Callable[..., Watched]) -> None:
    watched = watch(script("a", SLEEPER), script("b", SLEEPER), limits=ControlTable(heartbeat_timeout_s=2.5))
    watched.until(lambda: watched.said("a", "up") and watched.said("b", "up"))
    a, b = watched.row("a")["pid"], watched.row("b")["pid"]
    assert isinstance(a, int)
    assert isinstance(b, int)
    watched.keeper.heartbeat("a", a, watched.clock_s())
    os.kill(a, signal.SIGSTOP)

    def pass_time() -> None:
        watched.keeper.heartbeat("b", b, watched.clock_s())
        watched.ahead_s += 0.5  # more at once would be the keeper's own standing still
        time.sleep(0.05)  # in which the keeper looks

    until(lambda: watched.row("a")["pid"] not in (0, a), step=pass_time)
    assert watched.row("b")["pid"] == b


def test_program_that_is_not_there_fails_with_the_reason(watch: Callable[..., Watched]) -> None:
    spec = ProcessSpec("a", Role.INGEST, ("/nonexistent/python",), {})
    watched = watch(spec, limits=ControlTable(backoff_first_s=0.01, crash_limit=2))
    watched.until(lambda: watched.row("a")["state"] == "FAILED")
    assert "cannot be started" in str(watched.row("a")["reason"])


def test_apply_removes_adds_and_restarts_only_what_changed(watch: Callable[..., Watched]) -> None:
    keep, change, drop = script("keep", SLEEPER), script("change", SLEEPER), script("drop", SLEEPER)
    watched = watch(keep, change, drop)
    watched.until(lambda: all(watched.said(id_, "up") for id_ in ("keep", "change", "drop")))
    before = {row["id"]: row["pid"] for row in watched.keeper.rows()}
    changed = ProcessSpec("change", Role.INGEST, change.argv, {}, b"other table")
    assert watched.keeper.apply([keep, changed, script("new", SLEEPER)]) == {"removed": ["drop"], "added": ["new"], "restarted": ["change"]}
    watched.until(lambda: watched.said("change", "up", 2) and watched.said("new", "up"))
    watched.until(lambda: {row["id"] for row in watched.keeper.rows()} == {"keep", "change", "new"})
    assert watched.row("keep")["pid"] == before["keep"]
    assert watched.row("change")["pid"] != before["change"]


def test_lines_lose_control_characters_and_our_records_give_level_and_text() -> None:
    plain_line = parse_line("a", b"\x1b[31mred\x07", error_stream=True)
    assert plain_line.text == "?[31mred?"
    assert not plain_line.structured
    record = parse_line("a", b'{"level": "ERROR", "text": "no \\u001b device"}', error_stream=False)
    assert (record.level, record.text, record.structured) == ("error", "no ? device", True)
    assert parse_line("a", b'{"broken', error_stream=False).text == '{"broken'


def test_endpoints() -> None:
    assert tcp_address("tcp/127.0.0.1:7547") == ("127.0.0.1", 7547)
    assert tcp_address("tcp/[::1]:7547#iface=lo") == ("::1", 7547)
    assert tcp_address("tls/127.0.0.1:7548") is None
    taken = subprocess.Popen(
        [sys.executable, "-c", "import socket as s; l = s.create_server(('127.0.0.1', 0)); print(l.getsockname()[1], flush=True); input()"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    assert taken.stdout is not None
    port = int(taken.stdout.readline())
    assert accepts(f"tcp/127.0.0.1:{port}")
    assert not is_free(f"tcp/127.0.0.1:{port}")
    taken.communicate(b"\n")
    assert is_free(f"tcp/127.0.0.1:{port}")
    assert not accepts(f"tcp/127.0.0.1:{port}")
