"""A raw u-blox, our caster that serves MSM4 made of it, and a rover that comes to a fix through it, as processes."""

from collections.abc import Callable

import numpy as np
import pytest
from tests.e2e.conftest import Deployment

from rtkmesh.gnss.time import GpsTime
from rtkmesh.simulation.scenario import truth

pytestmark = pytest.mark.e2e
TEXT = """
[ingest.rover]
source = "sim://static/rover"
[ingest.roof]
source = "sim://static/heading"
position_ecef_m = [{x}, {y}, {z}]
[output.caster]
target = "ntrip-caster://127.0.0.1:{port}"
mounts = {{ ROOF = "roof" }}
encode = "msm4"
station_id = 7
station_interval_s = 2.0
bytes_per_second = 3000.0
[ingest.base]
source = "ntrip://127.0.0.1:{port}/ROOF"
[solver.rtk]
rover = "rover"
base = "base"
navigation = ["rover"]
"""


@pytest.mark.slow
def test_a_rover_fixes_by_the_frames_that_were_made_of_raw_data(up: Callable[..., Deployment], free: int) -> None:
    """The fixes are right, the base knows its position and equipment from the stream, the ingest of the roof says what it made."""
    antennas = truth("static", seed=1)(GpsTime(2400, 0.0)).antennas_ecef_m
    x, y, z = antennas["heading"].tolist()
    deployment = up(TEXT.format(port=free, x=x, y=y, z=z))
    deployment.until(deployment.all_running, 280.0)  # the first time the kernels are compiled
    statuses, fixed = deployment.statuses(), deployment.fixes("rtk")
    deployment.until(lambda: len(fixed) >= 15, 60.0)
    deployment.until(lambda: {"roof", "base"} <= set(statuses) and statuses["roof"].counters.get("made_caster_epochs", 0) > 5)
    errors_m = [np.linalg.norm(np.subtract(solution.position_ecef_m, antennas["rover"])) for solution in fixed]
    assert max(errors_m) < 0.15, "the first second has few satellites"
    assert max(errors_m[5:]) < 0.05
    heard = statuses["base"].inputs[0].counters
    assert {"rtcm3/1006", "rtcm3/1008", "rtcm3/1033", "rtcm3/1074", "rtcm3/1094", "rtcm3/1019"} <= set(heard)
    assert not {name for name in heard if name.startswith("rtcm3/107") and name != "rtcm3/1074"}
    assert deployment.interrupt() == 0
