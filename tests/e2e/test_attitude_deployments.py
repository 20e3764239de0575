"""The shipped deployments of two, three and four antennas, on the simulator with truth, over real processes and Zenoh."""

from collections.abc import Callable
from math import degrees, isfinite, isnan
from pathlib import Path
from statistics import median

import numpy as np
import pytest
from tests.e2e.conftest import Deployment

from rtkmesh.attitude.rotation import wrapped
from rtkmesh.gnss.time import GpsTime
from rtkmesh.simulation.scenario import Truth, truth
from rtkmesh_schemas.attitude import AttitudeMessage
from rtkmesh_schemas.keys import ATT
from rtkmesh_schemas.wire import decode

pytestmark = [pytest.mark.e2e, pytest.mark.slow, pytest.mark.usefixtures("compiled")]

CONFIG = Path(__file__).parents[2] / "config"
WAIT_S = 150.0
# The antenna "bow" of the simulated boat, which three antennas do not measure: a point of the body whose true place is known.
BOW = "\n[attitude.boat.points.bow]\nposition_m = [1.0, 0.6, -2.0]\n"


def shipped(name: str) -> str:
    """Return a deployment's text without its hub."""
    text = (CONFIG / name).read_text()
    return text[text.index("\n[ingest.") :]


def attitudes(deployment: Deployment, name: str) -> list[AttitudeMessage]:
    """Return the attitudes from now on; what is returned goes on being filled."""
    found: list[AttitudeMessage] = []
    deployment.bus.subscribe(ATT.key(name), lambda sample: found.append(decode(AttitudeMessage, sample.payload, sample.encoding)))
    return found


def errors_deg(found: list[AttitudeMessage], at: Callable[[GpsTime], Truth], angle: str) -> list[float]:
    """Return what an angle is off by."""
    return [degrees(abs(wrapped(getattr(m, angle) - getattr(at(GpsTime(m.week, m.tow_s)), angle)))) for m in found]


def right(found: list[AttitudeMessage], antennas: int) -> list[AttitudeMessage]:
    """Return those of so many antennas that passed their tests."""
    return [m for m in found if m.integrity == "ok" and len(m.antennas_used) == antennas]


def ended(deployment: Deployment, found: list[AttitudeMessage]) -> None:
    """Nothing was ever called north that is not known; the deployment leaves nothing behind."""
    assert all(isnan(m.heading_rad) for m in found if m.integrity == "unavailable")
    waited_ms = median(m.waited_ms for m in found if m.integrity == "ok")
    print(f"published {waited_ms:.2f} ms after the last source of an epoch had arrived (median of {len(found)})")
    assert waited_ms < 20.0
    assert deployment.interrupt() == 0
    assert deployment.left() == []


def test_an_auv_with_two_antennas_has_a_heading_and_none_under_water(up: Callable[..., Deployment]) -> None:
    """Two kinematic solvers and a moving base: heading and pitch while there are fixes, NaN with a reason in a dive, and back."""
    deployment = up(shipped("dual_antenna.toml"))
    found = attitudes(deployment, "heading")
    deployment.until(lambda: len(right(found, 2)) >= 40, WAIT_S)
    dry = len(found)
    deployment.until(lambda: any(m.integrity == "unavailable" for m in found[dry:]), 60.0)  # it dives for 8 of every 30 s
    dived = len(found)
    deployment.until(lambda: len(right(found[dived:], 2)) >= 10, 60.0)
    good, at = right(found, 2), truth("auv", seed=1)
    assert median(errors_deg(good, at, "heading_rad")) < 1.0
    assert median(errors_deg(good, at, "pitch_rad")) < 2.0
    assert all(isnan(m.roll_rad) for m in good)
    assert any(isfinite(m.points["origin"].height_m) for m in good)
    ended(deployment, found)


def test_three_antennas_have_the_whole_attitude_and_any_point(up: Callable[..., Deployment]) -> None:
    """One kinematic solver, two moving bases: heading, pitch, roll, and the place of an antenna that is not measured."""
    deployment = up(shipped("triple_antenna.toml") + BOW)
    found = attitudes(deployment, "boat")
    deployment.until(lambda: sum(isfinite(m.points["bow"].height_m) for m in right(found, 3)) >= 30, WAIT_S)
    good, at = right(found, 3), truth("boat", seed=1)
    for angle, limit_deg in (("heading_rad", 0.6), ("pitch_rad", 1.2), ("roll_rad", 1.5)):
        assert median(errors_deg(good, at, angle)) < limit_deg
    placed = [m for m in good if isfinite(m.points["bow"].height_m)]
    off_m = [np.linalg.norm(np.array(m.points["bow"].position_ecef_m) - bow_of(at, m)) for m in placed]
    assert median(off_m) < 0.08
    ended(deployment, found)


def bow_of(at: Callable[[GpsTime], Truth], message: AttitudeMessage) -> np.ndarray:
    """Return where the antenna at the bow truly was."""
    return at(GpsTime(message.week, message.tow_s)).antennas_ecef_m["bow"]


def test_four_receivers_go_on_with_three_and_say_so(up: Callable[..., Deployment]) -> None:
    """A solver is stopped: its antenna is missing, the rest goes on with larger sigmas; started again, it is back."""
    deployment = up(shipped("four_receivers.toml"))
    found = attitudes(deployment, "boat")
    deployment.until(lambda: len(right(found, 4)) >= 15, WAIT_S)
    before = len(found)
    assert deployment.ask("left", "stop").ok
    deployment.until(lambda: len(right(found[before:], 3)) >= 10, 60.0)
    assert deployment.ask("left", "start").ok
    three, back = right(found[before:], 3), len(found)
    deployment.until(lambda: len(right(found[back:], 4)) >= 5, WAIT_S)
    four, at = right(found, 4), truth("boat", seed=1)
    assert three[-1].antennas_used == ["rear_left", "rear_right", "front_right"]
    assert three[-1].covariance_rad2[0] > four[-1].covariance_rad2[0]
    for angle, limit_deg in (("heading_rad", 0.5), ("pitch_rad", 1.0), ("roll_rad", 1.2)):
        assert median(errors_deg(four, at, angle)) < limit_deg
        assert median(errors_deg(three, at, angle)) < 1.5 * limit_deg
    ended(deployment, found)


def test_one_receiver_with_two_antennas(up: Callable[..., Deployment]) -> None:
    """A UM982's raw observations of both antennas through one port."""
    deployment = up(shipped("um982.toml"))
    found = attitudes(deployment, "heading")
    deployment.until(lambda: len(right(found, 2)) >= 30, WAIT_S)
    assert median(errors_deg(right(found, 2), truth("demo", seed=1), "heading_rad")) < 1.0
    ended(deployment, found)


def test_the_receivers_own_headings_stand_in_for_our_baseline(up: Callable[..., Deployment]) -> None:
    """UNIHEADING in the bytes of the UM982, first alone until our solver has its first fix, and while that is stopped."""
    deployment = up(shipped("um982.toml"))
    found, at = attitudes(deployment, "heading"), truth("demo", seed=1)
    deployment.until(lambda: sum(m.sources == {"heading_rtk": "baseline"} for m in right(found, 2)) >= 5, WAIT_S)
    assert deployment.ask("heading_rtk", "stop").ok
    stopped = len(found)

    def own() -> list[AttitudeMessage]:
        return [m for m in right(found[stopped:], 2) if m.sources == {"main": "heading"}]

    deployment.until(lambda: len(own()) >= 25, 60.0)
    good = own()
    off_deg = errors_deg(good, at, "heading_rad")
    assert median(off_deg) < 0.6
    assert all(error < 5.0 * degrees(m.covariance_rad2[0] ** 0.5) for error, m in zip(off_deg, good, strict=True))
    assert median(errors_deg(good, at, "pitch_rad")) < 1.2
    ended(deployment, found)
