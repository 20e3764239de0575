"""A replay through the processes gives the same solutions as `rtkmesh solve` on the same files, to the last bit."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from rtkmesh.rtk.solution import Solution
from rtkmesh_schemas.config import Deployment
from rtkmesh_schemas.keys import SOL, STATUS
from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_schemas.status import ServiceStatus
from rtkmesh_schemas.wire import decode
from rtkmesh_services.cli.offline import Run, open_inputs
from rtkmesh_services.control.endpoints import free_port
from rtkmesh_services.ingest.replay import date_of
from rtkmesh_services.ingest.urls import parse_source
from rtkmesh_services.mapping.options import session_options
from rtkmesh_services.mapping.position import known_position
from rtkmesh_services.mapping.solution import solution_message
from rtkmesh_services.runtime.bus import Sample
from rtkmesh_services.runtime.configuration import load_deployment
from rtkmesh_services.runtime.zenoh_bus import open_bus

REPOSITORY = Path(__file__).resolve().parents[2]
RUN_DEPENDENT = {"source", "start_id", "sequence", "waited_s", "solve_ms", "received_mono_ns", "published_mono_ns"}
_INTERPOLATED = "\n[solver.rtk.sync]\ninterpolate = true\n"


@contextmanager
def running(file: Path, data: Path, *options: str) -> Iterator[subprocess.Popen[bytes]]:
    """A deployment of its own process group that is interrupted at the end and must leave nothing."""
    command = [sys.executable, "-m", "rtkmesh_services.cli.main", "up", str(file), "--quiet", "--data", str(data), *options]
    process = subprocess.Popen(command, start_new_session=True)
    try:
        yield process
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        process.wait(60.0)


def replayed(name: str, data: Path, folder: Path, speed: str, more: str) -> list[SolutionMessage]:
    """Run a shipped configuration, with more lines, on a port of its own; return the solver's solutions as the bus gave them."""
    port = free_port()
    file = folder / name
    file.write_text((REPOSITORY / "config" / name).read_text().replace("tcp/127.0.0.1:7547", f"tcp/127.0.0.1:{port}") + more)
    messages: list[SolutionMessage] = []
    with running(file, data, "--speed", speed, "--exit-at-end") as process, open_bus("test", (f"tcp/127.0.0.1:{port}",)) as bus:
        bus.subscribe(SOL.key("rtk"), lambda sample: messages.append(decode(SolutionMessage, sample.payload, sample.encoding)))
        assert process.wait(240.0) == 0
    return messages


def offline(file: Path, data: Path) -> tuple[Deployment, list[Solution]]:
    """Solve the same recordings in this process, as `rtkmesh solve` does."""
    deployment = load_deployment(file, data)
    table = deployment.solver["rtk"]
    ingests = deployment.ingest
    navigation = tuple(Path(parse_source(ingests[n].source).path) for n in table.navigation if n not in (table.rover, table.base))
    rover, base = (Path(parse_source(ingests[n].source).path) for n in (table.rover, table.base))
    inputs = open_inputs(rover, base, navigation, date_of(ingests[table.rover].date))
    options = session_options(table, replay=True, base_position_ecef_m=known_position(ingests[table.base]))
    return deployment, list(Run(inputs, options, causal=True).solutions())


@pytest.mark.e2e
@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "speed", "more"),
    [
        ("replay_rinex.toml", "max", ""),
        ("replay_rinex.toml", "30", ""),
        ("replay_ubx.toml", "max", ""),
        ("replay_ubx.toml", "max", _INTERPOLATED),
        ("replay_rtcm3.toml", "max", ""),
    ],
)
def test_every_solution_equals_the_offline_one_bit_for_bit(name: str, speed: str, more: str, data: Path, tmp_path: Path) -> None:
    """Also where three of four base epochs are lost, and interpolated."""
    messages = replayed(name, data, tmp_path, speed, more)
    deployment, solutions = offline(tmp_path / name, data)
    assert not more or sum(solution.age_s < -0.5 for solution in solutions) > 100, "the nearest base epoch is a later one"
    table = deployment.solver["rtk"]
    names = {"source": "rtk", "start_id": "", "sequence": 0, "mode": table.mode, "rover": table.rover, "base": table.base}
    expected = [solution_message(solution, **names) for solution in solutions]
    assert len(messages) == len(expected) > 100
    assert [m.sequence for m in messages] == list(range(len(expected)))
    for got, want in zip(messages, expected, strict=True):
        differing = [f for f in got.__struct_fields__ if f not in RUN_DEPENDENT and repr(getattr(got, f)) != repr(getattr(want, f))]
        assert not differing, f"{got.week} {got.tow_s}: {[(f, getattr(got, f), getattr(want, f)) for f in differing[:3]]}"


@pytest.mark.e2e
@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize("killed", ["rover", "base", "rtk"])
def test_a_replay_in_which_a_process_is_killed_goes_on_to_its_end(killed: str, data: Path, tmp_path: Path) -> None:
    """Control brings the process back; no epoch comes twice, and only a killed solver loses some."""
    port = free_port()
    file = tmp_path / "replay.toml"
    file.write_text((REPOSITORY / "config" / "replay_ubx.toml").read_text().replace("tcp/127.0.0.1:7547", f"tcp/127.0.0.1:{port}"))
    times: list[float] = []
    pids: dict[str, int] = {}
    with running(file, data, "--speed", "150", "--exit-at-end") as process, open_bus("test", (f"tcp/127.0.0.1:{port}",)) as bus:

        def take(sample: Sample) -> None:
            times.append(decode(SolutionMessage, sample.payload, sample.encoding).tow_s)
            if len(times) == 300:
                os.kill(pids[killed], signal.SIGKILL)

        def note(sample: Sample) -> None:
            status = decode(ServiceStatus, sample.payload, sample.encoding)
            pids[status.id] = status.pid

        bus.subscribe(STATUS.expression(), note, history=True)
        bus.subscribe(SOL.key("rtk"), take)
        assert process.wait(240.0) == 0
    assert len(set(times)) == len(times)
    assert len(times) == 1205 if killed != "rtk" else 600 < len(times) < 1205
