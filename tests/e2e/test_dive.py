"""The dive scenario of the rtkrcv_ros paper: a rule stops the solver under water and starts it at the surface."""

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import zenoh
from tests.e2e.conftest import Deployment

from rtkmesh.gnss.time import GpsTime
from rtkmesh.simulation.environment import Window
from rtkmesh.simulation.scenario import SCENARIOS, truth
from rtkmesh.simulation.sky import absolute_s
from rtkmesh_schemas.keys import EVENT
from rtkmesh_schemas.status import Event
from rtkmesh_schemas.wire import decode
from rtkmesh_services.ingest.replay import gps_now
from rtkmesh_services.runtime.bus import Sample
from rtkmesh_services.runtime.clock import Clock

pytestmark = [pytest.mark.e2e, pytest.mark.slow, pytest.mark.usefixtures("compiled")]

CONFIG = Path(__file__).parents[2] / "config" / "dive.toml"
EARLY_S = 1.0  # a vehicle that dives leaves the surface before its antenna hears nothing


@contextmanager
def depth_sensor(endpoint: str) -> Iterator[None]:
    """A program of the vehicle's own, with Zenoh only: says its depth ten times a second."""
    config, stopping, window = zenoh.Config(), threading.Event(), under_water()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")

    def say() -> None:
        with zenoh.open(config) as session:
            while not stopping.wait(0.1):
                now_s = absolute_s(gps_now(Clock()))
                session.put("vehicle/depth", json.dumps({"depth_m": 1.0 if window.holds(now_s) else 0.1}))

    thread = threading.Thread(target=say, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stopping.set()
        thread.join(10.0)


def under_water() -> Window:
    """Return when the vehicle is below the surface: a little longer than its antenna hears nothing."""
    window = SCENARIOS["auv"].windows[0]
    return Window(window.period_s, window.start_s - EARLY_S, window.duration_s + EARLY_S, window.hidden_below_rad)


def test_the_solver_rests_under_water_and_no_fix_is_wrong(up: Callable[..., Deployment]) -> None:
    """Stopped by the rule after every dive's beginning, started after its end, and each surface has right fixes only."""
    text = CONFIG.read_text()
    deployment = up(text[text.index("[ingest.rover]") :])
    statuses, fixes, told = deployment.statuses(), deployment.fixes("auv_position"), list[Event]()

    def note(sample: Sample) -> None:
        event = decode(Event, sample.payload, sample.encoding)
        if event.code.startswith("rule"):
            told.append(event)

    for level in ("info", "warning", "error"):
        deployment.bus.subscribe(EVENT.key("control", level=level), note, history=True)

    def codes(code: str) -> int:
        return sum(event.code == code for event in told)

    with depth_sensor(deployment.endpoint):
        deployment.until(lambda: fixes, 90.0)
        begun = codes("rule_begun")  # a dive may have been over before the solver was there
        deployment.until(lambda: codes("rule_begun") > begun, 60.0)
        deployment.until(lambda: statuses["auv_position"].state == "STOPPED")
        before, ended = len(fixes), codes("rule_ended")
        deployment.until(lambda: codes("rule_ended") > ended)
        surfaced = time.monotonic()
        deployment.until(lambda: len(fixes) >= before + 20, 60.0)
        assert time.monotonic() - surfaced < 20.0
    assert not [event.text for event in told if event.code == "rule_failed"]
    at, window = truth("auv", seed=1), SCENARIOS["auv"].windows[0]
    for fix in fixes:
        when = GpsTime(fix.week, fix.tow_s)
        assert not window.holds(absolute_s(when))
        assert np.linalg.norm(np.array(fix.position_ecef_m) - at(when).antennas_ecef_m["rover"]) < 0.15
    assert deployment.interrupt() == 0
    assert deployment.left() == []
