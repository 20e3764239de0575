"""What known places of antennas give a boat with GPS on one frequency, over real processes and Zenoh, with truth."""

from collections.abc import Callable
from math import degrees, isfinite
from statistics import median

import pytest
from tests.e2e.conftest import Deployment

from rtkmesh.attitude.rotation import wrapped
from rtkmesh.gnss.time import GpsTime
from rtkmesh.simulation.scenario import truth
from rtkmesh_schemas.attitude import AttitudeMessage
from rtkmesh_schemas.keys import ATT
from rtkmesh_schemas.wire import decode

pytestmark = [pytest.mark.e2e, pytest.mark.slow, pytest.mark.usefixtures("compiled")]

ENOUGH = 25  # attitudes by geometry: how soon they come depends on the hour's satellites and on the machine
SOLVER = """
[solver.to_{name}]
rover = "{name}"
base = "rear"
mode = "moving-base"
systems = "G"
frequencies = 1
"""
DEPLOYMENT = """
[ingest.rear]
source = "sim://boat/rover?rate=5"

[ingest.front]
source = "sim://boat/heading?rate=5"

[ingest.right]
source = "sim://boat/starboard?rate=5"

[attitude.two]
solver = "to_front"
length_m = 2.0
max_tilt_deg = 15.0

[attitude.two_alone]
solver = "to_front"
length_m = 2.0
geometry = false

[attitude.three]
solvers = ["to_front", "to_right"]

[attitude.three_alone]
solvers = ["to_front", "to_right"]
geometry = false
"""
PLACES = """
[attitude.{name}.antennas]
rear = {{ position_m = [-1.0, -0.6, -2.0] }}
front = {{ position_m = [1.0, -0.6, -2.0] }}
right = {{ position_m = [-1.0, 0.6, -2.0] }}
"""
LIMITS_DEG = {"heading_rad": 1.5, "pitch_rad": 3.0, "roll_rad": 5.0}  # a wrong integer on 2 m is 3 degrees or more, on 1.2 m 5


def deployment_text() -> str:
    """Return two solvers that know no length, and attitudes with and without geometry of both."""
    solvers = [SOLVER.format(name=name) for name in ("front", "right")]
    return DEPLOYMENT + "".join(solvers) + "".join(PLACES.format(name=name) for name in ("three", "three_alone"))


def test_known_places_give_one_frequency_an_attitude_at_once(up: Callable[..., Deployment]) -> None:
    """The same floats: with places two and three antennas soon have attitudes, without them not yet; none is wrong."""
    deployment = up(deployment_text())
    found: dict[str, list[AttitudeMessage]] = {name: [] for name in ("two", "two_alone", "three", "three_alone")}
    for name, messages in found.items():
        deployment.bus.subscribe(ATT.key(name), lambda s, to=messages: to.append(decode(AttitudeMessage, s.payload, s.encoding)))
    deployment.until(lambda: min(len(usable(found[name])) for name in ("two", "three")) >= ENOUGH, 150.0)
    good = {name: usable(messages) for name, messages in found.items()}
    by_geometry = [m for m in (*good["two"], *good["three"]) if "geometry" in m.sources.values()]
    print({name: len(messages) for name, messages in good.items()}, f"waited {median(m.waited_ms for m in by_geometry):.2f} ms")
    assert len(good["two"]) >= len(good["two_alone"]) + ENOUGH // 2
    assert len(good["three"]) >= len(good["three_alone"]) + ENOUGH // 2
    assert len(by_geometry) >= ENOUGH // 2
    assert {m.geometry for m in by_geometry} == {"accepted"}
    assert all(m.geometry_wrong_probability <= 0.01 for m in by_geometry)
    assert [m for messages in good.values() for m in messages if not is_right(m)] == []
    assert deployment.interrupt() == 0


def usable(messages: list[AttitudeMessage]) -> list[AttitudeMessage]:
    """Return the attitudes whose integrity is ok."""
    return [m for m in list(messages) if m.integrity == "ok"]


def is_right(message: AttitudeMessage) -> bool:
    """Return whether all angles that are known are near the truth."""
    true = truth("boat", seed=1)(GpsTime(message.week, message.tow_s))
    off_deg = {angle: degrees(abs(wrapped(getattr(message, angle) - getattr(true, angle)))) for angle in LIMITS_DEG}
    return all(off < LIMITS_DEG[angle] for angle, off in off_deg.items() if isfinite(off))
