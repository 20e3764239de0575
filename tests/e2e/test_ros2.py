"""The bridge against real ROS 2 (Jazzy, Fast DDS): what real receivers' bytes gave comes out as topics; services act."""

import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from math import atan2, degrees
from pathlib import Path

import numpy as np
import pytest

from rtkmesh.gnss.frames import enu_from_ecef_at, geodetic_from_ecef
from rtkmesh_services.control.endpoints import free_port

REPOSITORY = Path(__file__).resolve().parents[2]
ROVER_ECEF_M = np.array([-4467074.3577, 2683011.9038, -3667008.2845])
BASE_ECEF_M = np.array([-4467102.3061, 2683039.5304, -3666949.9820])

DEPLOYMENT = """
[deployment]
name = "ros"
[hub]
listen = ["tcp/127.0.0.1:{port}"]
[ingest.rover]
source = "file://{data}/stromlo_rtcm/week-rollover-STR24.rtcm3?speed=10"
date = "2018-07-14"
[ingest.base]
source = "file://{data}/stromlo_rtcm/week-rollover-STR17.rtcm3?speed=10"
date = "2018-07-14"
position_ecef_m = [-4467102.3061, 2683039.5304, -3666949.9820]
[solver.rtk]
rover = "rover"
base = "base"
systems = "GRE"
[solver.vector]
rover = "rover"
base = "base"
mode = "moving-base"
systems = "GRE"
[attitude.heading]
solver = "vector"
[attitude.body]
solvers = ["vector"]
positions = ["rtk"]
[attitude.body.antennas]
base = {{ position_m = [0.0, 0.0, 0.0], sigma_m = 0.05 }}
rover = {{ position_m = [{length_m}, 0.0, 0.0], sigma_m = 0.05 }}
[attitude.body.points.middle]
position_m = [{half_m}, 0.0, 0.0]
[attitude.body.filter]
[ros2.bridge]
python = "{python}"
poses = {{ body = "middle" }}
map_origin = [{lat_deg}, {lon_deg}, {height_m}]
"""


@pytest.fixture(scope="session")
def ros_python() -> str:
    """The interpreter that has rclpy (`make ros` makes it, x86-64 Linux); missing on CI is a failure."""
    python = os.environ.get("RTKMESH_ROS_PYTHON", str(REPOSITORY / ".venv-ros" / "bin" / "python"))
    if not Path(python).is_file():
        if os.environ.get("CI"):
            pytest.fail("no ROS environment on CI: make ros")
        pytest.skip("no ROS environment: make ros, or set RTKMESH_ROS_PYTHON")
    return python


class Listener:
    """The ROS program of ros_listener.py and what it said."""

    def __init__(self, python: str, environment: dict[str, str]) -> None:
        script = Path(__file__).with_name("ros_listener.py")
        self.process = subprocess.Popen(
            [python, str(script)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment, start_new_session=True
        )
        self._lines: queue.Queue[dict] = queue.Queue()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._lines.put(json.loads(line))

    def until(self, wanted: Callable[[dict], bool], timeout_s: float = 60.0) -> dict:
        """Return the first message that is wanted; queue.Empty when none comes in time."""
        end = time.monotonic() + timeout_s
        while True:
            message = self._lines.get(timeout=max(0.0, end - time.monotonic()))
            if wanted(message):
                return message

    def drain(self) -> None:
        while not self._lines.empty():
            self._lines.get_nowait()

    def quiet(self, topic: str, seconds: float) -> bool:
        """Whether no message of the topic comes for so long."""
        try:
            self.until(lambda m: m.get("topic") == topic, seconds)
        except queue.Empty:
            return True
        return False

    def close(self) -> None:
        self.process.kill()
        self.process.wait(10.0)
        for pipe in (self.process.stdin, self.process.stdout):
            assert pipe is not None
            pipe.close()

    def call(self, service: str) -> dict:
        assert self.process.stdin is not None
        self.process.stdin.write(service + "\n")
        self.process.stdin.flush()
        return self.until(lambda m: m.get("service") == service)


@pytest.fixture
def listener(ros_python: str, data: Path, tmp_path: Path) -> Iterator[Listener]:
    port = free_port()
    file = tmp_path / "ros.toml"
    length_m = float(np.linalg.norm(ROVER_ECEF_M - BASE_ECEF_M))
    lat_rad, lon_rad, height_m = geodetic_from_ecef(BASE_ECEF_M)
    origin = {"lat_deg": degrees(lat_rad), "lon_deg": degrees(lon_rad), "height_m": height_m}
    file.write_text(DEPLOYMENT.format(port=port, data=data, python=ros_python, length_m=length_m, half_m=length_m / 2.0, **origin))
    environment = {**os.environ, "ROS_DOMAIN_ID": str(1 + port % 100), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    heard = Listener(ros_python, environment)
    heard.until(lambda m: "ready" in m)
    up = subprocess.Popen(
        [sys.executable, "-m", "rtkmesh_services.cli.main", "up", str(file), "--quiet"], env=environment, start_new_session=True
    )
    try:
        yield heard
    finally:
        up.send_signal(signal.SIGINT)
        assert up.wait(15.0) == 0
        heard.close()


@pytest.mark.e2e
@pytest.mark.ros
@pytest.mark.data
def test_topics_and_services(listener: Listener) -> None:
    """Position, velocity, heading and diagnostics agree with the known antennas; stop stops, start starts."""
    fix = listener.until(lambda m: m.get("topic") == "fix" and 0.0 < m["cov"][0] < 1e-3)
    lat_rad, lon_rad, height_m = geodetic_from_ecef(ROVER_ECEF_M)
    assert (fix["lat"], fix["lon"]) == (pytest.approx(degrees(lat_rad), abs=3e-7), pytest.approx(degrees(lon_rad), abs=3e-7))
    assert fix["alt"] == pytest.approx(height_m, abs=0.12)
    assert (fix["status"], fix["kind"], fix["frame"]) == (2, 3, "gnss_antenna")
    assert 1531612000 < fix["stamp"] < 1531614600  # 2018-07-14 23:50 UTC and the minutes after
    velocity = listener.until(lambda m: m.get("topic") == "velocity")
    assert np.linalg.norm(velocity["v"]) < 0.3
    heading = listener.until(lambda m: m.get("topic") == "heading")
    x, y, z, w = heading["q"]
    east, north, _ = enu_from_ecef_at(BASE_ECEF_M) @ (ROVER_ECEF_M - BASE_ECEF_M)
    assert atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)) == pytest.approx(atan2(north, east), abs=0.002)
    assert heading["rate"] == -1.0
    quaternion = listener.until(lambda m: m.get("topic") == "heading_quaternion")
    assert quaternion["frame"] == "map"
    assert quaternion["q"][:2] == [0.0, 0.0]
    assert 2.0 * atan2(quaternion["q"][2], quaternion["q"][3]) == pytest.approx(atan2(north, east), abs=0.002)
    told = listener.until(lambda m: m.get("topic") == "diagnostics" and m["messages"].get("rtkmesh/solver: rtk") == "FIX")
    assert {"rtkmesh/ingest: rover", "rtkmesh/attitude: heading"} <= set(told["messages"])

    assert listener.call("/rtk/stop")["success"]
    listener.drain()
    assert listener.quiet("fix", 2.0)
    again = listener.call("/rtk/stop")
    assert not again["success"]
    assert "already" in again["message"]
    assert listener.call("/rtk/start")["success"]
    listener.until(lambda m: m.get("topic") == "fix")


@pytest.mark.e2e
@pytest.mark.ros
@pytest.mark.data
def test_the_body_has_a_pose_in_the_map_and_a_twist_of_its_own(listener: Listener) -> None:
    """Half-way between two known antennas, pointing from one to the other; at rest. The map begins at the base."""
    enu = enu_from_ecef_at(BASE_ECEF_M) @ (ROVER_ECEF_M - BASE_ECEF_M)
    pose = listener.until(lambda m: m.get("topic") == "pose" and m["cov"][0] < 1e-2)
    assert pose["frame"] == "map"
    assert pose["p"] == pytest.approx((enu / 2.0).tolist(), abs=0.15)
    x, y, z, w = pose["q"]
    forward = [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]
    assert forward == pytest.approx((enu / np.linalg.norm(enu)).tolist(), abs=0.005)
    assert all(pose["cov"][7 * k] > 0.0 for k in range(6))
    twist = listener.until(lambda m: m.get("topic") == "twist")
    assert twist["frame"] == "base_link"
    assert np.linalg.norm(twist["v"]) < 1.5
    assert np.linalg.norm(twist["w"]) < 0.2
    assert all(twist["cov"][7 * k] > 0.0 for k in range(6))
