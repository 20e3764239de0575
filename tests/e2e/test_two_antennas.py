"""One receiver with two antennas, one port and two ingests: heading by our own moving base, over real processes and Zenoh."""

import queue
from collections.abc import Callable
from functools import partial
from math import degrees, pi

import pytest
from tests.e2e.conftest import Deployment

from rtkmesh.gnss.time import GpsTime
from rtkmesh.simulation.scenario import truth
from rtkmesh_schemas.attitude import AttitudeMessage
from rtkmesh_schemas.keys import ATT, EPH, OBS
from rtkmesh_schemas.observation import Observation
from rtkmesh_schemas.wire import decode
from rtkmesh_services.runtime.bus import Sample

pytestmark = [pytest.mark.e2e, pytest.mark.slow, pytest.mark.usefixtures("compiled")]


DEPLOYMENT = """
[ingest.main]
source = "sim://demo/rover+heading?rate=5"

[ingest.second]
source = "ingest://main?antenna=2"

[solver.heading_rtk]
rover = "second"
base = "main"
mode = "moving-base"

[attitude.heading]
solver = "heading_rtk"
"""


def test_both_antennas_of_one_receiver_give_a_heading(up: Callable[..., Deployment]) -> None:
    """The second ingest decodes the first one's frames: its epochs are the same instants, ephemerides reach it, and the heading is true."""
    deployment = up(DEPLOYMENT)
    attitudes: queue.Queue[AttitudeMessage] = queue.Queue()
    epochs: dict[str, set[tuple[int, float]]] = {"main": set(), "second": set()}
    ephemerides: set[str] = set()
    for name, instants in epochs.items():
        deployment.bus.subscribe(OBS.key(name), partial(note, instants))
    deployment.bus.subscribe(EPH.key("second", satellite="*"), lambda s: ephemerides.add(s.key), history=True)
    deployment.bus.subscribe(ATT.key("heading"), lambda s: attitudes.put(decode(AttitudeMessage, s.payload, s.encoding)))
    found: list[AttitudeMessage] = []

    def enough() -> bool:
        while not attitudes.empty():
            attitude = attitudes.get()
            if attitude.integrity == "ok":
                found.append(attitude)
        return len(found) >= 20 and len(ephemerides) >= 10

    deployment.until(enough, 120.0)
    at = truth("demo", seed=1)
    errors_deg = []
    for attitude in found:
        heading_rad = at(GpsTime(attitude.week, attitude.tow_s)).heading_rad
        errors_deg.append(degrees(abs((attitude.heading_rad - heading_rad + pi) % (2.0 * pi) - pi)))
    assert sorted(errors_deg)[len(errors_deg) // 2] < 1.0, errors_deg
    both = epochs["main"] & epochs["second"]
    assert len(both) >= 0.9 * len(epochs["second"]), "the same instants: no delay between the two"
    assert deployment.interrupt() == 0
    assert deployment.left() == []


def note(instants: set[tuple[int, float]], sample: Sample) -> None:
    """Remember the instant of an epoch."""
    observation = decode(Observation, sample.payload, sample.encoding)
    instants.add((observation.week, observation.tow_s))
