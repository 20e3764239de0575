"""A base station, its caster and a rover that comes to a fix through it, as processes; the password is nowhere to be read."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.e2e.conftest import Deployment, free_besides

pytestmark = pytest.mark.e2e
SECRET = "c4nary@/?#word"
TEXT = """
[ingest.rover]
source = "sim://demo/rover"
[ingest.roof]
source = "sim://demo/base"
[output.caster]
target = "ntrip-caster://127.0.0.1:{caster}"
mounts = {{ ROOF = "roof" }}
protocol = "rtcm3"
users = {{ "me@mail.example" = "${{PASSWORD}}" }}
[ingest.base]
source = "ntrip://me@mail.example:${{PASSWORD}}@127.0.0.1:{caster}?nearest"
[ingest.stranger]
source = "ntrip://me@mail.example:${{PASSWORD}}x@127.0.0.1:{caster}/ROOF"
[solver.rtk]
rover = "rover"
base = "base"
navigation = ["rover"]
"""


@pytest.mark.slow
def test_a_rover_fixes_by_the_nearest_mount_point_of_our_caster(up: Callable[..., Deployment], free: int) -> None:
    """The rover's single solution finds the mount point, its frames bring the fix; the wrong password is said, the right one nowhere."""
    deployment = up(TEXT.format(caster=free), PASSWORD=SECRET)
    seen: list[bytes] = []
    deployment.until(deployment.all_running, 280.0)  # the first time the kernels are compiled
    deployment.bus.subscribe("rtk/**", lambda sample: seen.append(sample.payload))
    statuses, fixed = deployment.statuses(), deployment.fixes("rtk")
    deployment.until(lambda: len(fixed) > 10, 60.0)
    deployment.until(lambda: {"base", "caster", "stranger"} <= set(statuses))
    assert statuses["base"].inputs[0].detail == f"ntrip://127.0.0.1:{free}/ROOF (HTTP/1.1)"
    assert "401 Unauthorized: the caster does not take this password" in statuses["stranger"].reason
    assert [row.name.split()[0] for row in statuses["caster"].inputs] == ["caster", "client"]
    told = [deployment.ask(name, "config").data for name in ("base", "stranger", "caster")]
    assert "***" in str(told[0])
    assert "***" in str(told[2])
    listed = run("ntrip", "list", f"127.0.0.1:{free}", "--near", "52.5,13.4", "--json")
    assert [(row["name"], row["authentication"], row["format"]) for row in json.loads(listed)] == [("ROOF", "B", "RTCM 3.3")]
    lines = [Path(f"/proc/{row['pid']}/cmdline").read_bytes() for row in deployment.rows().values() if row["pid"]]
    assert deployment.interrupt() == 0
    written = deployment.events + deployment.log
    for place in (str(told), str(written), *map(str, seen), *map(str, lines)):
        assert SECRET not in place
        assert "c4nary" not in place


TWO_WAYS = """
[ingest.rover]
source = "sim://static/rover"
[ingest.roof]
source = "sim://static/base"
[output.one]
target = "ntrip-caster://127.0.0.1:{first}"
mounts = {{ ROOF = "roof" }}
[output.two]
target = "ntrip-caster://127.0.0.1:{second}"
mounts = {{ ROOF = "roof" }}
[ingest.base]
source = "ntrip://127.0.0.1:{first}/ROOF"
fallback = ["ntrip://127.0.0.1:{second}/ROOF"]
fallback_after_s = 1.5
return_after_s = 3.0
[solver.rtk]
rover = "rover"
base = "base"
navigation = ["rover"]
mode = "static"
"""


@pytest.mark.slow
def test_a_caster_that_dies_is_replaced_by_the_next_one_and_taken_again(up: Callable[..., Deployment], free: int, other: int) -> None:
    """No fix is wrong meanwhile; the status says which source is used and why."""
    deployment = up(TWO_WAYS.format(first=free, second=other))
    deployment.until(deployment.all_running, 280.0)
    statuses, fixed = deployment.statuses(), deployment.fixes("rtk")

    def fixes(count: int) -> None:
        before = len(fixed)
        deployment.until(lambda: len(fixed) >= before + count, 60.0)

    fixes(10)
    assert deployment.ask("control", "stop", id="one").ok
    deployment.until(lambda: statuses["base"].data.get("source") == 1)
    fixes(10)
    assert statuses["base"].reason.startswith(f"using fallback 1, ntrip://127.0.0.1:{other}/ROOF")
    assert "the first choice: " in statuses["base"].reason
    assert deployment.ask("control", "start", id="one").ok
    deployment.until(lambda: statuses["base"].data.get("source") == 0, 60.0)
    fixes(10)
    first = fixed[9].position_ecef_m
    assert max(abs(a - b) for one in fixed for a, b in zip(one.position_ecef_m, first, strict=True)) < 0.15


def run(*arguments: str) -> str:
    command = [sys.executable, "-m", "rtkmesh_services.cli.main", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=60, env=os.environ.copy()).stdout


@pytest.fixture
def other(port: int, free: int) -> int:
    """A third one."""
    return free_besides(port, free)
