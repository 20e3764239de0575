"""Keepers one after the other over the same real, tiny processes: what is as wanted is never touched."""

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest
from tests.patience import PATIENCE_S, until

from rtkmesh_schemas.config import ControlTable, Deployment, IngestTable, SolverTable
from rtkmesh_schemas.keys import Role
from rtkmesh_schemas.status import State
from rtkmesh_services.control.adoption import Adopted, end_all, hubs_last, wait_gone
from rtkmesh_services.control.fleet import ProcessSpec
from rtkmesh_services.control.keeper import Keeper
from rtkmesh_services.control.memory import Memory
from rtkmesh_services.control.process import Child, start_program
from rtkmesh_services.control.registry import DeploymentFolder
from rtkmesh_services.control.supervisor import EXIT_UNKNOWN, Supervisor
from rtkmesh_services.runtime.host_processes import Identity, identity_of, is_alive
from rtkmesh_services.runtime.memory_bus import MemoryBus, MemoryNetwork
from rtkmesh_services.runtime.service import Context
from rtkmesh_services.solver.service import SolverService

LIMITS = ControlTable(term_grace_s=0.3)
SLEEPER = "import time; print('up', flush=True); time.sleep(600)"
STUBBORN = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('up', flush=True); time.sleep(600)"
FAMILY = "import subprocess, time; c = subprocess.Popen(['sleep', '600']); print(c.pid, flush=True); time.sleep(600)"
TELLS = "import os, time; print('running', os.environ.get('RTKMESH_RUNNING'), flush=True); time.sleep(600)"


class Watch:
    """A keeper with a memory, whose changes can be waited for."""

    def __init__(self, folder: Path, *specs: ProcessSpec, fresh: bool = False) -> None:
        self.changed = threading.Condition()
        self.memory = Memory(DeploymentFolder(folder), fresh=fresh)
        self.ahead_s = 0.0
        self.told: list[tuple[str, str]] = []  # of ids and states, also of those that pass quickly
        self.keeper = Keeper(list(specs), LIMITS, clock_s=lambda: time.monotonic() + self.ahead_s, memory=self.memory)
        self.keeper.on_change(self._change)
        self.keeper.begin()

    def _change(self, row: dict[str, Any]) -> None:
        with self.changed:
            self.told.append((row["id"], row["state"]))
            self.changed.notify_all()

    def until(self, what: Callable[[], Any], timeout_s: float = PATIENCE_S) -> Any:
        with self.changed:
            assert self.changed.wait_for(what, timeout_s), self.keeper.rows()
        return what()

    def row(self, id_: str) -> dict[str, Any]:
        return next(row for row in self.keeper.rows() if row["id"] == id_)

    def up(self, *ids: str) -> dict[str, int]:
        """Wait until processes are there and have written their first line; return their pids."""
        self.until(lambda: all(self.row(id_)["pid"] for id_ in ids))
        for id_ in ids:
            until(lambda: any(not line.startswith("info") for line in self.keeper.last_lines(id_, 1)))  # noqa: B023  used at once
        return {id_: self.row(id_)["pid"] for id_ in ids}

    def beat(self, id_: str, start_id: str = "s1") -> None:
        self.keeper.heartbeat(id_, self.row(id_)["pid"], time.monotonic() + self.ahead_s, start_id)


@pytest.fixture
def watch(tmp_path: Path) -> Iterator[Callable[..., Watch]]:
    """A function that makes the next keeper of the folder; what the last one has is ended."""
    made: list[Watch] = []

    def make(*specs: ProcessSpec, fresh: bool = False) -> Watch:
        if made:
            assert made[-1].keeper.let_go()
        made.append(Watch(tmp_path, *specs, fresh=fresh))
        return made[-1]

    yield make
    assert made[-1].keeper.end()
    for child in [child for one in made for child in one.keeper._children.values() if isinstance(child, Child)]:
        child._process.wait()  # of a keeper that let go: here all keepers are one process
    for identity in DeploymentFolder(tmp_path).strays(set()):
        os.kill(identity.pid, signal.SIGKILL)
        pytest.fail("a process is left")


@pytest.fixture
def spec(tmp_path: Path) -> Callable[..., ProcessSpec]:
    def make(id_: str, code: str = SLEEPER, tables: bytes = b"", role: Role = Role.INGEST) -> ProcessSpec:
        argv = (sys.executable, "-S", "-E", "-c", code)
        return ProcessSpec(id_, role, argv, {}, tables, DeploymentFolder(tmp_path).log_file(id_))

    return make


def test_the_next_keeper_takes_over_and_touches_nothing(watch: Any, spec: Any) -> None:
    """The same processes, their restarts and uptime too; RUNNING only when they are heard."""
    first = watch(spec("a"), spec("b"))
    pids = first.up("a", "b")
    os.kill(pids["a"], signal.SIGKILL)
    first.until(lambda: first.row("a")["pid"] not in (0, pids["a"]))
    pids = first.up("a", "b")
    first.beat("a", "run_of_a")
    until(lambda: first.row("a")["state"] == "RUNNING")
    second = watch(spec("a"), spec("b"))
    rows = {row["id"]: row for row in second.keeper.rows()}
    assert {id_: row["pid"] for id_, row in rows.items()} == pids
    assert (rows["a"]["restarts"], rows["b"]["restarts"]) == (1, 0)
    assert (rows["a"]["state"], rows["a"]["reason"], rows["a"]["start_id"]) == ("STARTING", "taken over, not heard yet", "run_of_a")
    second.beat("a", "of another run with this pid on another host")
    assert second.row("a")["state"] == "STARTING"
    second.beat("a", "run_of_a")
    assert second.row("a")["state"] == "RUNNING"
    assert all(0.0 < row["uptime_s"] < 60.0 for row in rows.values())


def test_only_what_has_changed_is_restarted_and_only_what_is_gone_is_ended(watch: Any, spec: Any) -> None:
    pids = watch(spec("same"), spec("changed"), spec("removed")).up("same", "changed", "removed")
    second = watch(spec("same"), spec("changed", tables=b"other"), spec("added"))
    second.until(lambda: second.row("changed")["pid"] not in (0, pids["changed"]))
    until(lambda: [row["id"] for row in second.keeper.rows()] == ["same", "changed", "added"])
    after = second.up("same", "changed", "added")
    assert after["same"] == pids["same"]
    until(lambda: identity_of(pids["removed"]) is None)
    assert second.row("changed")["restarts"] == 1


def test_a_change_that_a_dying_control_did_not_finish_is_finished_by_the_next(watch: Any, spec: Any) -> None:
    """What runs keeps its old definition in the memory until it is replaced."""
    pids = watch(spec("a", STUBBORN)).up("a")
    second = watch(spec("a", STUBBORN, tables=b"other"))
    second.until(lambda: ("a", "STOPPING") in second.told)
    third = watch(spec("a", STUBBORN, tables=b"other"))
    third.until(lambda: third.row("a")["pid"] not in (0, pids["a"]))


def test_what_ended_meanwhile_is_started_and_counted(watch: Any, spec: Any) -> None:
    first = watch(spec("a"), spec("b"))
    pids = first.up("a", "b")
    assert first.keeper.let_go()
    os.kill(pids["a"], signal.SIGKILL)
    until(lambda: identity_of(pids["a"]) is None)
    second = watch(spec("a"), spec("b"))
    assert second.up("a", "b")["b"] == pids["b"]
    assert second.row("a")["restarts"] == 1
    assert list(second.keeper.found.ended) == ["a"]


def test_the_end_of_an_adopted_process_is_seen_and_repaired(watch: Any, spec: Any) -> None:
    """At once, by its pidfd; with the last words of its log, and what it left in its group goes too."""
    ids = ("a", "b", "c")  # of which one is replaced at once: the machine may stand still in others
    first = watch(*(spec(id_, FAMILY) for id_ in ids))
    pids = first.up(*ids)
    grandchildren = [int(first.keeper.last_lines(id_, 1)[0]) for id_ in ids]
    second, took_s = watch(*(spec(id_, FAMILY) for id_ in ids)), list[float]()
    for id_, pid in pids.items():
        begun_s = time.monotonic()
        os.kill(pid, signal.SIGKILL)
        second.until(lambda: second.row(id_)["pid"] not in (0, pid))  # noqa: B023  used at once
        took_s.append(time.monotonic() - begun_s)
    assert min(took_s) < 1.0
    assert [second.row(id_)["restarts"] for id_ in ids] == [1, 1, 1]
    until(lambda: not any(map(identity_of, grandchildren)))


def test_a_silent_adopted_process_is_replaced(watch: Any, spec: Any) -> None:
    """Hung while no control was there: others are heard, it is not."""
    first = watch(spec("a"), spec("b"))
    pids = first.up("a", "b")
    first.beat("a")
    until(lambda: first.row("a")["state"] == "RUNNING")
    second = watch(spec("a"), spec("b"))
    second.until(lambda: second.row("a")["pid"] == pids["a"])

    def pass_time() -> None:
        second.ahead_s += 0.5  # more at once would be the keeper's own standing still
        second.beat("b")
        time.sleep(0.05)  # in which the keeper looks

    until(lambda: second.row("a")["pid"] not in (0, pids["a"]), step=pass_time)
    assert second.row("b")["pid"] == pids["b"]


def test_an_adopted_process_that_ignores_term_is_killed(watch: Any, spec: Any) -> None:
    pid = watch(spec("a", STUBBORN)).up("a")["a"]
    second = watch(spec("a", STUBBORN))
    second.keeper.stop("a")
    second.until(lambda: second.row("a")["state"] == "STOPPED")
    assert identity_of(pid) is None


def test_a_recycled_pid_is_never_taken(watch: Any, spec: Any, tmp_path: Path) -> None:
    """The registry names a process that lives and is another one: it is left alone, and ours is started."""
    bystander = start_program(replace(spec("bystander"), log_file=tmp_path / "elsewhere"))
    try:
        who = identity_of(bystander.pid)
        assert who is not None
        first = watch(spec("a"))
        first.up("a")
        assert first.keeper.end()
        folder = DeploymentFolder(tmp_path)
        running = first.memory._running
        old = msgspec.structs.replace(running.processes["a"], identity=Identity(who.pid, who.start_ticks - 100, who.world))
        folder.write_running(msgspec.structs.replace(running, processes={"a": old}))
        second = watch(spec("a"))
        assert second.up("a")["a"] != who.pid
        assert second.row("a")["restarts"] == 1
        second.keeper.stop("a")
        second.until(lambda: second.row("a")["state"] == "STOPPED")
        assert is_alive(who)
        with pytest.raises(ProcessLookupError):
            Adopted(spec("a"), replace(who, start_ticks=1))
    finally:
        os.kill(bystander.pid, signal.SIGKILL)
        bystander.wait()


def test_what_was_stopped_by_command_stays_stopped_until_it_is_fresh(watch: Any, spec: Any) -> None:
    first = watch(spec("a"), spec("b"))
    first.up("a", "b")
    first.keeper.stop("a")
    first.until(lambda: first.row("a")["state"] == "STOPPED")
    second = watch(spec("a"), spec("b"))
    assert (second.row("a")["state"], second.row("a")["wanted"], second.row("a")["reason"]) == ("STOPPED", False, "stopped by command")
    third = watch(spec("a"), spec("b"), fresh=True)
    assert third.up("a")
    assert third.row("a")["wanted"]


def test_stopped_while_control_died_is_still_stopped(watch: Any, spec: Any) -> None:
    """The word was written, the deed not done: the next control does it."""
    first = watch(spec("a", STUBBORN))
    pid = first.up("a")["a"]
    first.keeper.stop("a")
    first.until(lambda: ("a", "STOPPING") in first.told)
    second = watch(spec("a", STUBBORN))
    second.until(lambda: second.row("a")["state"] == "STOPPED")
    assert identity_of(pid) is None


@pytest.mark.parametrize(("running", "says"), [(False, "running 0"), (True, "running 1"), (None, "running None")])
def test_a_solver_goes_on_as_the_one_before_it_was_told(watch: Any, spec: Any, running: bool | None, says: str) -> None:
    """Across its restart and across that of control."""
    solver = spec("a", TELLS, role=Role.SOLVER)
    first = watch(solver)
    pid = first.up("a")["a"]
    first.keeper.solver_told("a", pid + 1, not running)  # of a process that is not ours
    first.keeper.solver_told("a", pid, running)
    second = watch(solver)
    assert second.row("a")["told"] == {None: "", True: "start", False: "stop"}[running]
    second.keeper.restart("a")
    second.until(lambda: second.row("a")["pid"] not in (0, pid))
    second.up("a")
    assert second.keeper.last_lines("a", 1) == [says]


def test_apply_keeps_what_is_stopped_and_forgets_what_is_removed(watch: Any, spec: Any, tmp_path: Path) -> None:
    first = watch(spec("a"), spec("b"), spec("c"))
    first.up("a", "b", "c")
    for id_ in ("a", "b"):
        first.keeper.stop(id_)
    first.until(lambda: first.row("a")["state"] == first.row("b")["state"] == "STOPPED")
    changes = first.keeper.apply([spec("a", tables=b"other"), spec("c")])
    assert changes == {"removed": ["b"], "added": [], "restarted": ["a"]}
    assert first.row("a")["state"] == "STOPPED"
    until(lambda: DeploymentFolder(tmp_path).desired().stopped == {"a"})
    first.keeper.apply([spec("a"), spec("b"), spec("c")])
    first.until(lambda: first.row("b")["pid"])


def test_processes_that_are_no_children_end_by_grace_or_by_force(spec: Any, tmp_path: Path) -> None:
    started = [start_program(spec("a")), start_program(spec("b", STUBBORN))]
    folder = DeploymentFolder(tmp_path)
    until(lambda: all(b"up" in folder.log_file(id_).read_bytes() for id_ in ("a", "b")))
    strays = folder.strays(set())
    assert sorted(strays.values()) == ["a", "b"]
    assert end_all(strays, 0.3) == []
    assert [process.wait() for process in started] == [-signal.SIGTERM, -signal.SIGKILL]
    assert wait_gone(strays, 0.0) == []
    assert hubs_last([]) == ([], [])


def test_an_unknown_exit_is_told_without_a_code() -> None:
    supervisor = Supervisor(LIMITS)
    supervisor.add(ProcessSpec("a", Role.INGEST, ()))
    supervisor.adopt("a", 7, "", 0.0, 1.0)
    supervisor.exited("a", EXIT_UNKNOWN, "no such port", 2.0)
    assert supervisor.rows(2.0)[0]["reason"] == "it ended: no such port"


@pytest.mark.parametrize(
    ("autostart", "told", "runs"), [(True, None, True), (True, False, False), (False, None, False), (False, True, True)]
)
def test_a_solver_starts_as_control_says_before_it_starts_as_its_table_says(autostart: bool, told: bool | None, runs: bool) -> None:
    deployment = Deployment(
        ingest={"rover": IngestTable(source="tcp://127.0.0.1:1")},
        solver={"rtk": SolverTable(rover="rover", mode="single", autostart=autostart)},
    )
    context = Context(id="rtk", role=Role.SOLVER, deployment=deployment, bus=MemoryBus("rtk", MemoryNetwork()), running=told)
    report = SolverService(context).report()
    assert report.data["running"] is runs
    assert (report.state is State.STOPPED) is not runs
