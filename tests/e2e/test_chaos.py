"""Killing and freezing processes of a running deployment: the others run on, and everything comes back by itself."""

import os
import random
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.e2e.conftest import Deployment
from tests.patience import PATIENCE_S, until

from rtkmesh_schemas.keys import SOL
from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_schemas.wire import decode
from rtkmesh_services.runtime.shipped import config_path

pytestmark = [pytest.mark.e2e, pytest.mark.slow, pytest.mark.usefixtures("compiled")]
IDS = ("rover", "rover2", "base", "rtk", "heading_rtk", "heading", "hub")
FIX = 1


class Fixes:
    """When the solver ``rtk`` last gave a fix."""

    def __init__(self, deployment: Deployment) -> None:
        self.last_s = 0.0
        self.handle = deployment.bus.subscribe(SOL.key("rtk"), self._take)

    def _take(self, sample: object) -> None:
        message = decode(SolutionMessage, sample.payload, sample.encoding)  # type: ignore[attr-defined]  a Sample
        if message.status == FIX:
            self.last_s = time.monotonic()

    def since(self, begun_s: float) -> bool:
        return self.last_s > begun_s


@pytest.fixture
def fleet(up: Callable[..., Deployment]) -> Deployment:
    """The demo's deployment, fixing."""
    text = config_path("demo.toml").read_text().partition("[hub]")[2].partition("\n\n")[2]
    deployment = up(text)
    deployment.until(deployment.all_running)
    fixes = Fixes(deployment)
    deployment.until(lambda: fixes.since(0.0))
    return deployment


def test_every_process_killed_in_turn_comes_back_and_the_others_run_on(fleet: Deployment) -> None:
    fixes = Fixes(fleet)
    took_s: dict[str, float] = {}
    for id_ in IDS:
        before = fleet.until(fleet.all_running)
        begun_s = time.monotonic()
        os.kill(before[id_]["pid"], signal.SIGKILL)
        fleet.until(lambda: (row := fleet.rows().get(id_)) and row["pid"] not in (0, before[id_]["pid"]))  # noqa: B023  used at once
        respawned_s = time.monotonic()
        fleet.until(lambda: fixes.since(respawned_s))  # noqa: B023  used at once
        took_s[id_] = fixes.last_s - begun_s
        after = fleet.until(fleet.all_running)
        assert {name for name in after if after[name]["pid"] != before[name]["pid"]} == {id_}
        assert after[id_]["restarts"] == 1
    print({id_: round(seconds, 2) for id_, seconds in took_s.items()})
    assert max(took_s.values()) < 20.0


def test_random_kills_in_a_row_are_all_repaired(fleet: Deployment) -> None:
    chosen = random.Random(20261122)
    fixes = Fixes(fleet)
    for _ in range(4):
        rows = fleet.rows()
        for id_ in chosen.sample(IDS[:-1], 2):
            if pid := rows[id_]["pid"]:
                os.kill(pid, signal.SIGKILL)
        begun_s = time.monotonic()
        fleet.until(fleet.all_running)
        fleet.until(lambda: fixes.since(begun_s))  # noqa: B023  used at once
    assert fleet.interrupt() == 0
    assert fleet.left() == []


def test_frozen_solver_is_replaced_and_the_frozen_one_is_gone(fleet: Deployment) -> None:
    fixes = Fixes(fleet)
    before = fleet.until(fleet.all_running)
    os.kill(before["rtk"]["pid"], signal.SIGSTOP)
    row = fleet.until(lambda: (row := fleet.rows()["rtk"]) and row["pid"] not in (0, before["rtk"]["pid"]) and row)
    assert row["restarts"] == 1
    begun_s = time.monotonic()
    fleet.until(lambda: fixes.since(begun_s))
    assert any("hung: no heartbeat" in event.get("reason", "") for event in fleet.events)
    after = fleet.until(fleet.all_running)
    assert {name for name in after if after[name]["pid"] != before[name]["pid"]} == {"rtk"}


def test_without_the_fork_server_all_run_on_and_nobody_survives_control(fleet: Deployment) -> None:
    """The fork server is nobody's parent: its end ends nobody, and the end of control ends all that it forked."""
    before = fleet.rows()
    [server] = [pid for pid in fleet.left() if Path(f"/proc/{pid}/cmdline").read_bytes().startswith(b"rtkmesh fork server")]
    os.kill(server, signal.SIGKILL)
    os.kill(before["rtk"]["pid"], signal.SIGKILL)
    fixes = Fixes(fleet)
    killed_s = time.monotonic()
    fleet.until(lambda: fleet.rows()["rtk"]["pid"] not in (0, before["rtk"]["pid"]) and fixes.since(killed_s + 0.5))
    after = fleet.rows()
    assert {id_: row["pid"] for id_, row in after.items() if id_ != "rtk"} == {
        id_: row["pid"] for id_, row in before.items() if id_ != "rtk"
    }
    fleet.process.kill()
    fleet.process.wait(PATIENCE_S)
    until(lambda: not fleet.left())
