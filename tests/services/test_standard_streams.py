"""A receiver's bytes from standard input, frames to standard output: real processes, real pipes."""

import subprocess
import sys
from pathlib import Path

import pytest
from tests.services.conftest import Fleet

from rtkmesh.codecs.rtcm3_encode import frame
from rtkmesh_schemas.status import State

FRAMES = [frame(bytes([0xFF, 0xE0 | number, *range(40)])) for number in range(8)]


@pytest.mark.e2e
def test_bytes_go_in_by_a_pipe_and_frames_come_out_of_one(site: Fleet, tmp_path: Path) -> None:
    site.config.write_text(
        f'[hub]\nlisten = ["{site.endpoint}"]\n[ingest.base]\nsource = "stdin://"\n[output.copy]\nreceiver = "base"\ntarget = "stdout://"\n'
    )
    command = [sys.executable, "-m", "rtkmesh_services.cli.main", "run"]
    copy_to = tmp_path / "copy"
    with copy_to.open("wb") as copied, site.bus() as bus:
        quiet = {"stdin": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        output = subprocess.Popen([*command, "output", "--id", "copy", "--config", str(site.config)], stdout=copied, **quiet)
        site.is_running(bus, "copy")
        ingest = subprocess.Popen(
            [*command, "ingest", "--id", "base", "--config", str(site.config)], stdin=subprocess.PIPE, stderr=subprocess.DEVNULL
        )
        try:
            site.is_running(bus, "base")
            assert ingest.stdin is not None
            site.status_until(bus, "base", lambda status: status.uptime_s > 0.0)
            for one in FRAMES:
                ingest.stdin.write(b"noise" + one)
            ingest.stdin.close()
            ended = site.status_until(bus, "base", lambda status: status.state is State.STOPPED)
            assert "standard input is at its end" in ended.reason
            site.until(lambda: copy_to.read_bytes().endswith(FRAMES[-1]))
        finally:
            for process in (ingest, output):
                process.terminate()
                process.wait(60.0)
    assert copy_to.read_bytes() == b"".join(FRAMES)
