"""Base stations as presets with real processes: two casters of simulated bases, selections, fail-over, a receiver that is plugged in."""

import json
import os
import pty
import threading
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from tests.e2e.conftest import FIX, Deployment, free_besides

from rtkmesh.gnss.time import GpsTime
from rtkmesh.simulation.scenario import open_stream
from rtkmesh_schemas.command import Reply
from rtkmesh_schemas.keys import EVENT, PRESET, SOL
from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_schemas.status import Event
from rtkmesh_schemas.wire import decode
from rtkmesh_services.cli.main import run
from rtkmesh_services.runtime.bus import Sample

pytestmark = pytest.mark.e2e
Up = Callable[..., Deployment]
RATE_HZ = 5.0
TWO_BASES = """
[ingest.rover]
source = "sim://two_bases/rover?rate=5"
[ingest.sim_near]
source = "sim://two_bases/base?rate=5"
[ingest.sim_far]
source = "sim://two_bases/base2?rate=5"
[output.caster_near]
target = "ntrip-caster://127.0.0.1:{near}"
mounts = {{ NEAR = "sim_near" }}
anonymous = true
[output.caster_far]
target = "ntrip-caster://127.0.0.1:{far}"
mounts = {{ FAR = "sim_far" }}
anonymous = true
[preset.near]
sources = ["ntrip://127.0.0.1:{near}/NEAR"]
standby = true
[preset.far]
sources = ["ntrip://127.0.0.1:{far}/FAR"]
standby = true
[bases]
hot_plug = false
failover_after_s = 2.0
[solver.rtk]
rover = "rover"
presets = ["near", "far"]
[solver.second]
rover = "rover"
"""


def preset(deployment: Deployment, action: str, **arguments: Any) -> Reply:
    return deployment.ask("control", "preset", action=action, **arguments)


def listed(deployment: Deployment) -> dict[str, dict[str, Any]]:
    return {row["id"]: row for row in preset(deployment, "list").data.get("presets", [])}


def scored(deployment: Deployment, name: str, least: float) -> Callable[[], bool]:
    """Return whether control's status gives a preset at least this score."""
    statuses = deployment.statuses()

    def look() -> bool:
        status = statuses.get("control")
        return status is not None and status.data.get("preset_scores", {}).get(name, {}).get("score", 0.0) > least

    return look


def solutions_of(deployment: Deployment, solver: str) -> list[SolutionMessage]:
    """Return all solutions from now on; what is returned goes on being filled."""
    found: list[SolutionMessage] = []

    def take(sample: Sample) -> None:
        found.append(decode(SolutionMessage, sample.payload, sample.encoding))

    deployment.bus.subscribe(SOL.key(solver), take)
    return found


def events_of(deployment: Deployment) -> list[Event]:
    found: list[Event] = []
    deployment.bus.subscribe(
        EVENT.key("*", level="*"), lambda sample: found.append(decode(Event, sample.payload, sample.encoding)), history=True
    )
    return found


def uses(solutions: list[SolutionMessage], base: str) -> Callable[[], bool]:
    """Return whether the newest solution is fixed with a base."""
    return lambda: bool(solutions) and solutions[-1].base == base and solutions[-1].status == FIX


@pytest.mark.usefixtures("compiled")
def test_bases_are_switched_for_all_and_for_one_and_fail_over_without_losing_an_epoch(up: Up, port: int, free: int, tmp_path: Path) -> None:
    far = free_besides(port, free)
    deployment = up(TWO_BASES.format(near=free, far=far))
    first, second = solutions_of(deployment, "rtk"), solutions_of(deployment, "second")
    events = events_of(deployment)
    deployment.until(uses(first, "base_near"), 90.0)  # the first of its list, without a word
    assert {solution.base for solution in second} <= {""}

    deployment.until(scored(deployment, "far", 0.5))
    begun = len(first)
    assert preset(deployment, "select", id="far").ok
    deployment.until(uses(first, "base_far"))
    deployment.until(uses(second, "base_far"))
    deployment.until(lambda: len([s for s in first if s.base == "base_far"]) > 10)
    changed = first[begun:]
    times = [round((s.week * 604800 + s.tow_s) * RATE_HZ) for s in changed]
    assert times == list(range(times[0], times[0] + len(times)))  # not one epoch is missing
    assert all(s.status == FIX for s in changed)
    [told] = [event for event in events if event.code == "base_changed" and event.data["old"] == "base_near"]
    assert max(map(abs, told.data["jump_enu_m"])) < 0.1
    assert not [event for event in events if event.code == "base_jump"]

    [answer] = deployment.bus.get(f"{PRESET.key('control', name='near')}?op=select;solver=second", timeout_s=15.0)
    assert decode(Reply, answer.payload, answer.encoding).ok
    deployment.until(uses(second, "base_near"))
    assert first[-1].base == "base_far"
    statuses = deployment.statuses()
    deployment.until(lambda: "second" in statuses and statuses["second"].data.get("base") == "base_near")
    rows = deployment.until(lambda: (told := listed(deployment))["near"]["used_by"] == ["second"] and told)
    assert rows["far"]["used_by"] == ["rtk"]
    assert (rows["near"]["selected"], rows["far"]["selected"]) == (False, True)
    assert 3.0e3 < rows["far"]["distance_m"] + rows["near"]["distance_m"] < 1.0e4

    before = second[-1].start_id
    assert deployment.ask("control", "restart", id="second").ok  # a solver that begins anew is told its base again
    deployment.until(lambda: second[-1].start_id != before and uses(second, "base_near")())

    assert deployment.ask("control", "stop", id="caster_far").ok
    deployment.until(uses(first, "base_near"), 60.0)
    failover = next(event for event in events if event.code == "preset_failover")
    assert (failover.data["solver"], failover.data["old"], failover.data["new"]) == ("rtk", "far", "near")
    assert listed(deployment)["far"]["selected"]  # it is what was chosen, and is taken again when it is back
    kept = json.loads((tmp_path / "state" / "preset_selection.json").read_text())
    assert (kept["fleet"], kept["solvers"]) == ("far", {"second": "near"})


@pytest.mark.usefixtures("compiled")
def test_presets_of_users_are_made_selected_kept_and_there_after_a_restart(
    up: Up, port: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = "[monitor.one]\n[bases]\nhot_plug = false\n"
    deployment = up(text)
    deployment.until(deployment.all_running)
    connect = ["--connect", f"tcp/127.0.0.1:{port}"]
    assert run(["preset", "list", *connect]) == 0
    assert run(["preset", "add", "mine", "sim://two_bases/base?rate=5", "--title", "Mine", *connect]) == 0
    assert run(["preset", "select", "mine", *connect]) == 0
    assert run(["preset", "select", "min", *connect]) == 1
    assert "did you mean 'mine'" in capsys.readouterr().err
    assert run(["preset", "update", "mine", "--fields", '{"standby": true}', *connect]) == 0
    deployment.until(scored(deployment, "mine", 0.5), 60.0)
    assert run(["preset", "list", *connect]) == 0
    assert "base_mine" in deployment.rows()
    assert "Mine" in capsys.readouterr().out
    assert run(["preset", "save", *connect]) == 0
    deployment.interrupt()
    assert deployment.left() == []
    again = up(text)
    again.until(scored(again, "mine", 0.5), 60.0)
    assert preset(again, "list").data["selected"] == "mine"
    assert run(["preset", "remove", "mine", *connect]) == 0
    again.until(lambda: "base_mine" not in again.rows())
    assert preset(again, "list").data["selected"] is None


class PluggedIn:
    """A base station's receiver on a pty with a name that comes and goes."""

    def __init__(self, name: Path) -> None:
        self._name, self._stop = name, threading.Event()
        self._master, self._slave = pty.openpty()
        tty.setraw(self._master)
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        threading.Thread(target=self._send, daemon=True).start()

    def plug(self) -> None:
        self._name.symlink_to(os.ttyname(self._slave))

    def unplug(self) -> None:
        self._name.unlink()

    def close(self) -> None:
        self._stop.set()

    def _send(self) -> None:
        start = GpsTime.from_calendar(2024, 3, 1, 12)
        for epoch in open_stream("two_bases", "base", seed=1, rate_hz=RATE_HZ, start=start).epochs():
            with suppress(BlockingIOError):
                os.write(self._master, epoch.data)
            with suppress(BlockingIOError):
                os.read(self._master, 65536)  # what it is asked, and does not answer
            if self._stop.wait(1.0 / RATE_HZ):
                break
        os.close(self._master)
        os.close(self._slave)


@pytest.fixture
def receiver(tmp_path: Path) -> Iterator[PluggedIn]:
    made = PluggedIn(tmp_path / "ttyBase")
    yield made
    made.close()


@pytest.mark.usefixtures("compiled")
def test_a_receiver_that_is_plugged_in_is_a_preset_and_is_selected_again_when_it_is_back(
    up: Up, receiver: PluggedIn, tmp_path: Path
) -> None:
    deployment = up(f'[monitor.one]\n[bases]\ndevices = ["{tmp_path}/ttyB*"]\n')
    deployment.until(deployment.all_running)
    events = events_of(deployment)
    mine = f"{tmp_path}/ttyBase/0".replace("/", "-")[-64:]
    assert mine not in listed(deployment)
    receiver.plug()
    found = deployment.until(lambda: listed(deployment).get(mine))
    assert (found["type"], found["auto_survey"]) == ("dynamic", True)
    chosen_s = time.monotonic()
    assert preset(deployment, "select", id=mine).ok
    deployment.until(scored(deployment, mine, 0.1), 60.0)
    receiver.unplug()
    deployment.until(lambda: mine not in listed(deployment))
    assert preset(deployment, "list").data["selected"] is None
    deployment.until(lambda: found["ingest"] not in deployment.rows())
    receiver.plug()
    deployment.until(lambda: mine in listed(deployment))
    if time.monotonic() - chosen_s < 28.0:  # a machine that is slower than that is not asked for more
        assert preset(deployment, "list").data["selected"] == mine
        deployment.until(lambda: [e.code for e in events if e.code.startswith("preset_")][-2:] == ["preset_lost", "preset_back"])
