"""``rtkmesh demo``: from simulated bytes to a fix and a heading, across real processes."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.e2e.conftest import Deployment

pytestmark = [pytest.mark.e2e, pytest.mark.slow, pytest.mark.usefixtures("compiled")]


def test_demo_fixes_within_seconds_and_agrees_with_the_truth() -> None:
    demo = Deployment(["demo", "--seconds", "30", "--json"], "")
    try:
        assert demo.wait(90.0) == 0, demo.text()
        assert demo.left() == []
        summary = demo.events[-1]
    finally:
        demo.close()
    assert summary["restarts"] == 0
    assert summary["processes"] == 8
    assert summary["start_to_fix_s"] < 25.0
    assert summary["ttff_s"] < 15.0
    assert summary["fix_pct"] > 90.0
    assert summary["horizontal_rms_m"] < 0.03
    assert summary["vertical_rms_m"] < 0.05
    assert summary["heading_epochs"] > 30
    assert summary["heading_rms_deg"] < 1.0
    assert summary["latency_p50_ms"] < 200.0


def test_demo_ends_well_at_ctrl_c_before_any_fix() -> None:
    demo = Deployment(["demo", "--json"], "")
    try:
        demo.until(lambda: len(demo.left()) >= 3)
        assert demo.interrupt() in (1, 130), demo.text()  # 130: before control was there to take the signal
        assert demo.left() == []
    finally:
        demo.close()


@pytest.mark.data
@pytest.mark.parametrize("name", ["replay_rinex", "replay_ubx", "replay_rtcm3"])
def test_shipped_replays_run_to_their_end_on_their_own(name: str, data: Path, port: int, tmp_path: Path) -> None:
    """Real recordings through all processes, as fast as they go: every epoch solved, nothing restarted, nothing left."""
    text = (Path(__file__).resolve().parents[2] / "config" / f"{name}.toml").read_text()
    file = tmp_path / f"{name}.toml"
    file.write_text(text.replace("127.0.0.1:7547", f"127.0.0.1:{port}"))
    command = ["up", str(file), "--data", str(data), "--speed", "max", "--exit-at-end", "--json"]
    replay = Deployment(command, f"tcp/127.0.0.1:{port}")
    try:
        assert replay.wait(200.0) == 0, replay.text()
        assert replay.left() == []
    finally:
        replay.close()
    end = replay.events[-1]
    epochs, fix_pct = {"replay_rinex": (301, 99.0), "replay_ubx": (1202, 80.0), "replay_rtcm3": (1134, 98.0)}[name]
    assert end["reason"] == "all recordings are at their end"
    assert end["solvers"]["rtk"]["epochs"] >= 0.99 * epochs
    assert end["solvers"]["rtk"]["fix_pct"] >= fix_pct
    assert all(row["restarts"] == 0 for row in end["processes"])


def test_unknown_recording_is_refused_with_its_line(tmp_path: Path) -> None:
    """A file that is not there is said before any process starts: file, line, exit code 2."""
    file = tmp_path / "d.toml"
    file.write_text('[ingest.rover]\nsource = "file:///nonexistent/rover.ubx"\n')
    command = [sys.executable, "-m", "rtkmesh_services.cli.main", "up", str(file)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert f"{file}:2: [ingest.rover] source: '/nonexistent/rover.ubx': no such file" in done.stderr


def test_recording_of_no_kind_leaves_the_deployment_up_and_says_so(up: Callable[..., Deployment], tmp_path: Path) -> None:
    """A file with rubbish in it is told in the receiver's status."""
    (tmp_path / "rubbish.ubx").write_bytes(bytes(range(256)) * 40)
    deployment = up(f'[ingest.rover]\nsource = "file://{tmp_path}/rubbish.ubx"\n')
    deployment.until(lambda: "no recording of a known kind" in json.dumps(deployment.ask("rover", "status").data))
    assert deployment.interrupt() == 0
    assert deployment.left() == []


def test_recording_of_no_kind_ends_a_replay_as_failed(up: Callable[..., Deployment], tmp_path: Path) -> None:
    """With --exit-at-end a recording that cannot be played is the end, with its reason and exit code 1."""
    (tmp_path / "empty.ubx").write_bytes(b"")
    deployment = up(f'[ingest.rover]\nsource = "file://{tmp_path}/empty.ubx"\n', "--exit-at-end")
    assert deployment.wait(60.0) == 1
    assert deployment.events[-1]["reason"].endswith("empty.ubx is empty")
    assert deployment.left() == []
