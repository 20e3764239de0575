"""What is imported runs: the files that users start from, on a recording whose rover stands on a known point, beside RTKLIB."""

import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rtkmesh_services.cli.main import run

SET = "kanagawa_2021_078_60s"
FILES = ("SEPT078M1.21O", "3034078M1.21O", "SEPT078M.21P")  # rover, base, navigation
TRUTH_ECEF_M = np.array([-3962108.673, 3381309.574, 3668678.638])  # data/README.md
BASE_ECEF_M = (-3959400.631, 3385704.533, 3667523.111)
FIX = "1"
WILD = [
    *(f"rtkrcv_ros/{name}" for name in ("Single_antenna", "dual_antenna_ant1", "dual_antenna_ant2", "dual_antenna_mbl")),
    *(f"rtkrcv_ros/tripple_antenna_{name}" for name in ("mbl1", "mbl2", "pos")),
    *(f"demo5/{name}" for name in ("demo5_m8n_1hz", "demo5_m8t_5hz", "f9p_ppk", "rtk", "rtknavi_example", "single")),
]


def on_the_known_point(path: Path, folder: Path) -> Path:
    """Return the file with the base of the recording and a .pos in ECEF, forward: nothing else of it is changed."""
    text = re.sub(r"(?m)^(ant2-(postype|pos\d)|pos1-soltype|out-solformat|out-timeform)\b.*$", "", path.read_text())
    place = "".join(f"ant2-pos{axis}={value}\n" for axis, value in zip("123", BASE_ECEF_M, strict=True))
    adapted = folder / path.name
    adapted.write_text(f"{text}\nant2-postype=xyz\n{place}out-solformat=xyz\nout-timeform=hms\n")
    return adapted


def track(path: Path) -> dict[str, list[str]]:
    """Return the lines of a .pos file by their time."""
    rows = [line.split() for line in path.read_text().splitlines() if not line.startswith("%")]
    return {row[1]: row for row in rows}


def positions(rows: dict[str, list[str]], status: str = "") -> dict[str, np.ndarray]:
    return {time: np.array([float(value) for value in row[2:5]]) for time, row in rows.items() if row[5] == (status or row[5])}


@pytest.mark.data
@pytest.mark.rtklib
@pytest.mark.slow
@pytest.mark.parametrize("name", WILD)
def test_the_files_of_the_wild_run(data: Path, rtklib_program: Callable[[str], str], tmp_path: Path, name: str):
    """Every epoch is solved; fixes are within 5 cm of the known point, and of RTKLIB's fixes of the same epochs with the same file."""
    conf = on_the_known_point(data / "conf" / f"{name}.conf", tmp_path)
    rover, base, navigation = (str(data / SET / file) for file in FILES)
    out, theirs = tmp_path / "ours.pos", tmp_path / "theirs.pos"
    words = ["--rover", rover, "--base", base, "--nav", navigation]
    moving = "mbl" in name  # it is where its own single positions are: the baseline counts
    form = ["--format", "enu"] if moving else []
    assert run(["solve", "--conf", str(conf), *words, "--out", str(out), "--quiet", *form]) == 0
    ours = track(out)
    single = name.endswith("single")
    assert len(ours) >= 58
    fixes = positions(ours, FIX)
    reach_m = 10.0 if single else 0.05
    checked = positions(ours) if single else fixes
    if moving:
        length_m = np.linalg.norm(TRUTH_ECEF_M - np.array(BASE_ECEF_M))
        assert len(fixes) >= 30
        assert np.percentile([abs(np.linalg.norm(place) - length_m) for place in fixes.values()], 95) < reach_m
        return
    assert len(checked) >= 30, name
    assert np.percentile([np.linalg.norm(place - TRUTH_ECEF_M) for place in checked.values()], 95) < reach_m
    subprocess.run(
        [rtklib_program("rnx2rtkp"), "-k", str(conf), "-o", str(theirs), rover, base, navigation], check=True, capture_output=True
    )
    others = positions(track(theirs), "5" if single else FIX)
    both = [float(np.linalg.norm(checked[time] - others[time])) for time in checked.keys() & others.keys()]
    if len(both) >= 20:
        assert np.median(both) < reach_m
