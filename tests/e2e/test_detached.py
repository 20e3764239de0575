"""Deployments that outlive their control: detach, kill -9, take over, down."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
from tests.e2e.conftest import Network, free_besides, is_running
from tests.patience import PATIENCE_S

from rtkmesh_schemas.keys import SOL
from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_schemas.wire import decode
from rtkmesh_services.cli.main import run

pytestmark = pytest.mark.e2e

TWO = "[monitor.one]\n[monitor.two]\n"
SOLVERS = """
[ingest.rover]
source = "sim://demo/rover"
[ingest.heading]
source = "sim://demo/heading"
[solver.rtk]
rover = "heading"
base = "rover"
mode = "moving-base"
[solver.alone]
rover = "rover"
mode = "single"
"""


class Detached(Network):
    """A deployment file and the commands that a user gives for it."""

    def __init__(self, file: Path, port: int, state: Path, text: str) -> None:
        super().__init__(f"tcp/127.0.0.1:{port}", {"RTKMESH_STATE": str(state)})
        self.file, self.head = file, f'[deployment]\nname = "{file.stem}"\n[hub]\nlisten = ["{self.endpoint}"]\n'
        self.write(text)

    def write(self, text: str) -> None:
        self.file.write_text(self.head + text)

    def run(self, *arguments: str, code: int = 0) -> str:
        """Run a command as a process of its own; return what it printed."""
        command = [sys.executable, "-m", "rtkmesh_services.cli.main", *arguments]
        done = subprocess.run(command, env=self.environment, capture_output=True, text=True, timeout=100, check=False)
        assert done.returncode == code, (arguments, done.stdout, done.stderr)
        return done.stdout if code == 0 else done.stdout + done.stderr

    def ask_here(self, *arguments: str, code: int = 0) -> str:
        """Run a command that starts nothing in this process, which is quicker; return what it printed."""
        with pytest.MonkeyPatch.context() as patch, StringIO() as out, redirect_stdout(out), redirect_stderr(out):
            patch.setenv("RTKMESH_STATE", self.environment["RTKMESH_STATE"])
            assert run(list(arguments)) == code, (arguments, out.getvalue())
            return out.getvalue()

    def up(self, *arguments: str, code: int = 0) -> dict[str, Any]:
        text = self.run("up", str(self.file), "--detach", "--json", *arguments, code=code)
        found: dict[str, Any] = json.loads(text)
        return found

    def picture(self, code: int = 0) -> dict[str, Any]:
        [found] = [one for one in json.loads(self.ask_here("ps", "--json", code=code)) if one["file"] == str(self.file)]
        return {**found, "processes": {row["id"]: row for row in found["processes"]}}

    def kill_control(self) -> None:
        pid = self.picture()["control"]
        os.kill(pid, signal.SIGKILL)
        self.until(lambda: not is_running(pid))

    def starts(self) -> dict[str, tuple[int, str]]:
        """Return pid and start id of every process that runs but control, as they say themselves."""
        statuses = self.statuses()
        self.until(lambda: (rows := self.rows()) and {id_ for id_, row in rows.items() if row["pid"]} <= set(statuses))
        return {id_: (status.pid, status.start_id) for id_, status in statuses.items() if id_ != "control"}

    def text(self) -> str:
        return self.ask_here("logs", "--of", str(self.file))


@pytest.fixture
def detached(tmp_path: Path, port: int) -> Iterator[Callable[..., Detached]]:
    """A function that gives a deployment of a name, not up yet."""
    made: list[Detached] = []

    def make(text: str = TWO, name: str = "robot") -> Detached:
        taken = [int(one.endpoint.rpartition(":")[2]) for one in made]
        made.append(Detached(tmp_path / f"{name}.toml", free_besides(*taken) if made else port, tmp_path / "state", text))
        return made[-1]

    yield make
    for one in made:
        one.kill_left()


def test_a_killed_control_is_replaced_and_nobody_notices(detached: Any) -> None:
    """The same processes and starts before and after; without control they are told and the deployment is not as wanted."""
    robot = detached()
    assert robot.up()["started"] == ["hub", "one", "two"]
    before, control = robot.starts(), robot.picture()["control"]
    for arguments in (["--detach"], ["--outlive", "--quiet"]):
        assert f"has a control already, pid {control}" in robot.run("up", str(robot.file), *arguments, code=2)
    robot.kill_control()
    orphaned = robot.picture(code=1)
    assert orphaned["control"] is None
    assert {id_: (row["state"], row["says"]) for id_, row in orphaned["processes"].items()} == dict.fromkeys(before, ("RUNNING", "RUNNING"))
    text = robot.ask_here("up", str(robot.file), code=2)
    assert "hub, one, two of robot run without control: `rtkmesh up --detach`" in text
    word = robot.up()
    assert (word["taken_over"], word["started"], word["restarted"]) == (["hub", "one", "two"], [], [])
    assert robot.starts() == before
    rows = robot.picture()["processes"]
    assert {id_: (rows[id_]["pid"], rows[id_]["start_id"]) for id_ in before} == before
    assert all(row["memory_bytes"] > 5e6 and row["restarts"] == 0 for row in rows.values())


def test_the_next_control_converges_to_what_is_wanted_now(detached: Any) -> None:
    """Killed meanwhile: started; changed: restarted; gone: ended; new: started; stopped by command: stopped; all else: untouched."""
    robot = detached(TWO + "[monitor.three]\n[monitor.four]\n[monitor.six]\n")
    robot.up()
    before = robot.starts()
    assert robot.ask("control", "stop", id="six").ok
    robot.until(lambda: robot.rows()["six"]["state"] == "STOPPED")
    robot.kill_control()
    os.kill(before["one"][0], signal.SIGKILL)
    robot.write("[monitor.one]\n[monitor.two]\nperiod_s = 2.0\n[monitor.three]\n[monitor.five]\n[monitor.six]\n")
    word = robot.up()
    assert (word["taken_over"], word["restarted"], sorted(word["started"])) == (["hub", "three"], ["two"], ["five", "one"])
    assert (word["removed"], word["stopped"]) == (["four"], ["six"])
    after = robot.starts()
    assert {id_ for id_ in after if after[id_] == before.get(id_)} == {"hub", "three"}
    robot.until(lambda: not is_running(before["four"][0]))
    rows = robot.picture()["processes"]
    assert rows["one"]["restarts"] == 1
    assert (rows["six"]["wanted"], rows["six"]["as_wanted"], rows["six"]["reason"]) == (False, True, "stopped by command")


def test_down_leaves_nothing_and_what_was_stopped_stays_so_until_up_is_fresh(detached: Any) -> None:
    """With control, without it, and with all frozen; over a reload too."""
    robot = detached()
    robot.up()
    assert robot.ask("control", "stop", id="one").ok
    robot.write(TWO.replace("[monitor.two]", "period_s = 2.0\n[monitor.two]"))
    assert robot.ask("control", "reload").data["restarted"] == ["one"]
    answer = json.loads(robot.ask_here("down", str(robot.file), "--json"))
    assert ({"hub", "two"} <= set(answer["ended"]), answer["left"], robot.left()) == (True, {}, [])
    assert "no deployment is up" in robot.ask_here("down", code=3)
    assert robot.up()["stopped"] == ["one"]
    robot.kill_control()
    assert "ended hub, two in" in robot.ask_here("down")
    assert robot.left() == []
    assert json.loads(robot.ask_here("ps", "--json", code=3)) == []
    assert robot.up("--fresh")["started"] == ["hub", "one", "two"]
    picture = robot.picture()
    for pid in (picture["control"], picture["processes"]["one"]["pid"]):
        os.kill(pid, signal.SIGSTOP)
    robot.ask_here("down", "robot", "--timeout", "0.3")
    assert robot.left() == []


def test_a_process_that_control_had_no_time_to_write_down_is_replaced(detached: Any) -> None:
    """Control died between the start of `two` and its note: no second one beside it, and `down` finds such a one too."""
    robot = detached()
    robot.up()
    before = robot.starts()

    def forget() -> None:
        robot.kill_control()
        [file] = (robot.file.parent / "state").rglob("processes.json")
        known = json.loads(file.read_bytes())
        del known["processes"]["two"]
        file.write_text(json.dumps(known))

    forget()
    assert robot.picture(code=1)["processes"]["two"]["reason"] == "no control knows it"
    word = robot.up()
    assert (word["taken_over"], word["started"]) == (["hub", "one"], ["two"])
    assert not is_running(before["two"][0])
    forget()
    assert "ended hub, one, two" in robot.ask_here("down")
    assert robot.left() == []


def test_two_deployments_of_one_host_do_not_disturb_each_other(detached: Any) -> None:
    """Neither the death nor the end of one touches the other; without a name the commands ask which; a port is taken by whom."""
    robot, boat = detached(), detached(name="boat")
    robot.up()
    boat.up()
    before = boat.starts()
    robot.kill_control()
    robot.up()
    assert "say which deployment" in robot.ask_here("down", code=2)
    assert "did you mean 'robot'" in robot.ask_here("down", "robt", code=2)
    robot.ask_here("down", "robot")
    assert robot.left() == []
    assert boat.starts() == before
    assert boat.picture()["as_wanted"]
    other = boat.file.with_name("other.toml")
    other.write_text(boat.file.read_text().replace('"boat"', '"other"'))
    assert f"is taken: by {boat.picture()['name']}" in boat.run("up", str(other), "--detach", code=2)


def test_logs_of_the_living_and_the_dead(detached: Any) -> None:
    """All by time, also what control says of a death; with -f what comes."""
    robot = detached()
    robot.up()
    command = [sys.executable, "-m", "rtkmesh_services.cli.main", "logs", "one", "-f", "-n", "1"]
    with subprocess.Popen(command, env=robot.environment, stdout=subprocess.PIPE, text=True) as follower:
        assert follower.stdout is not None
        assert "RUNNING" in follower.stdout.readline()
        assert robot.ask("one", "shutdown").ok
        assert any("started by control" in follower.stdout.readline() for _ in range(5))
        follower.send_signal(signal.SIGINT)
        assert follower.wait(PATIENCE_S) == 130
    robot.until(lambda: robot.rows()["one"]["restarts"] == 1 and robot.all_running())
    robot.ask_here("down")
    lines = [json.loads(line) for line in robot.ask_here("logs", "--json").splitlines()]
    assert {line["id"] for line in lines} == {"control", "hub", "one", "two"}
    assert [line["time"] for line in lines] == sorted(line["time"] for line in lines)
    texts = [line["text"] for line in lines if line["id"] == "one"]
    assert texts.count("started by control") == 2
    assert any("STOPPED shutdown by" in text for text in texts)
    assert robot.ask_here("logs", "two", "-n", "1").count("\n") == 1
    assert "control warning  monitor one is WAITING" in robot.ask_here("logs", "control", "--level", "warning")
    assert "did you mean 'two'" in robot.ask_here("logs", "tow", code=2)


def test_a_start_that_fails_says_why_and_leaves_nothing(detached: Any) -> None:
    """The hub cannot listen where it is told to."""
    robot = detached()
    robot.head = robot.head.replace("127.0.0.1", "127.0.0.1:1x")
    robot.write(TWO)
    text = robot.run("up", str(robot.file), "--detach", "--timeout", "20", code=2)
    assert "127.0.0.1:1x" in text
    assert robot.left() == []


@pytest.mark.slow
@pytest.mark.usefixtures("compiled")
def test_a_solver_fixes_on_while_control_is_killed_and_replaced(detached: Any) -> None:
    """No solution is missing, the solver's filter is the same; a killed solver is back, and one that was told to stop stays stopped."""
    robot = detached(SOLVERS)
    robot.up()
    solutions: list[SolutionMessage] = []
    robot.bus.subscribe(SOL.key("rtk"), lambda sample: solutions.append(decode(SolutionMessage, sample.payload, sample.encoding)))
    robot.until(lambda: solutions and solutions[-1].status == 1, 60.0)
    assert robot.ask("alone", "stop").ok
    before = robot.starts()
    robot.until(lambda: robot.rows()["alone"]["told"] == "stop")
    robot.kill_control()
    os.kill(before["alone"][0], signal.SIGKILL)
    count = len(solutions)
    robot.until(lambda: len(solutions) > count + 5)
    word = robot.up()
    assert word["started"] == ["alone"]
    count = len(solutions)
    robot.until(lambda: len(solutions) > count + 5)
    after = robot.starts()
    assert {id_ for id_ in before if after[id_] != before[id_]} == {"alone"}
    assert {message.start_id for message in solutions} == {before["rtk"][1]}
    numbers = [message.sequence for message in solutions]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    robot.until(lambda: robot.picture()["processes"]["alone"]["says"] == "STOPPED")
    row = robot.picture()["processes"]["alone"]
    assert (row["told"], row["restarts"]) == ("stop", 1)
    robot.until(lambda: robot.ask("alone", "start").ok)
    robot.until(lambda: robot.rows()["alone"]["told"] == "")
    robot.ask_here("down")
    assert robot.left() == []
