"""The comparison of speed runs demo5 as demo5 runs itself, and takes starts out of processes."""

import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

pyrtklib5 = pytest.importorskip("pyrtklib5", reason="pyrtklib5 has wheels for x86-64 only")
pytestmark = [pytest.mark.data, pytest.mark.rtklib]
NAMES = ("cases", "rtklib", "demo5_speed", "solver_speed")


def test_demo5_by_epochs_fixes_what_its_own_postpos_fixes(benchmarks: SimpleNamespace, data: Path, tmp_path: Path) -> None:
    """Pairing, systems and options of the timed ``rtkpos`` are those of ``postpos``: the same epochs, the same number of fixes."""
    (case,) = benchmarks.cases.load(data, ["kanagawa_60s"])
    argv = [sys.executable, benchmarks.demo5_speed.__file__, case.name, "--data", str(data), "--repeats", "1"]
    told = json.loads(subprocess.run(argv, check=True, capture_output=True, text=True).stdout.splitlines()[-1])
    files, out, none = [str(file) for file in benchmarks.rtklib.rinex(case, tmp_path)], tmp_path / "demo5.pos", pyrtklib5.gtime_t()
    processing, solution, other = benchmarks.demo5_speed.options(case), pyrtklib5.solopt_t(), pyrtklib5.filopt_t()
    assert pyrtklib5.postpos(none, none, 0.0, 0.0, processing, solution, other, files, len(files), str(out), "", "") == 0
    lines = [line.split() for line in out.read_text().splitlines() if line[0] != "%"]
    assert told["epochs"] == len(lines) == 60
    assert told["fixes"] == sum(line[5] == "1" for line in lines) > 30


def test_the_slope_takes_the_start_out(benchmarks: SimpleNamespace) -> None:
    """Two runs over parts of a file say what an epoch costs and what comes before the first."""
    found = benchmarks.solver_speed.slope(part_s=1.5 + 100 * 2e-3, whole_s=1.5 + 300 * 2e-3, part=100, whole=300)
    assert found.ms == pytest.approx(2.0)
    assert found.start_s == pytest.approx(1.5)
