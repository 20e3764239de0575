"""``rtkmesh antennas``: layouts from .pos files, TOML there and back, designs, pictures, and what wrong input is told."""

import json
import re
import threading
import tomllib
from math import nan
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from rtkmesh.attitude.rotation import NED_FROM_ENU, rotation_of_angles
from rtkmesh.gnss.frames import ecef_from_geodetic, enu_from_ecef_at, geodetic_from_ecef
from rtkmesh_schemas.keys import SOL
from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_services.cli.antenna_layouts import read_layouts
from rtkmesh_services.cli.main import EXIT_USAGE, run

TRUTH = {"rear": (0.0, 0.0, 0.0), "front": (1.2, 0.0, 0.0), "mast": (0.5, 0.6, -0.2), "left": (0.4, -0.5, 0.1)}
SIGMA_M = 0.003
START = ecef_from_geodetic(0.7, -0.006, 55.0)


LLH, ENU = "%  GPST  latitude(deg) longitude(deg)  height(m)   Q  ns\n", "%  GPST  e-baseline(m)  n-baseline(m)  u-baseline(m)   Q  ns\n"


def line(second: int, vector: np.ndarray, status: int, sigma_m: float) -> str:
    numbers = " ".join(f"{value:.11f}" for value in vector)
    return f"2232 {1000.0 + second:.3f} {numbers} {status} 9 {sigma_m:.4f} {sigma_m:.4f} {sigma_m:.4f} 0 0 0 0.0 5.0\n"


def geodetic(position: np.ndarray) -> np.ndarray:
    lat, lon, height = geodetic_from_ecef(position).tolist()
    return np.array([np.degrees(lat), np.degrees(lon), height])


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A vehicle that turns: positions of four antennas, baselines of two, with floats and wrong fixes among them."""
    folder, rng = tmp_path_factory.mktemp("pos"), np.random.default_rng(11)
    turn = enu_from_ecef_at(START).T @ NED_FROM_ENU
    texts = dict.fromkeys(TRUTH, LLH)
    texts["rear-front"] = ENU
    for second in range(120):
        body = rotation_of_angles(0.05 * second, 0.04, -0.02)
        places = {name: START + turn @ (body @ place + rng.normal(0.0, SIGMA_M, 3)) for name, place in TRUTH.items()}
        for name, place in places.items():
            wrong = second % 17 == 3 and name == "mast"
            texts[name] += line(second, geodetic(place + wrong * 0.3), 2 if second < 5 else 1, SIGMA_M)
        texts["rear-front"] += line(second, enu_from_ecef_at(START) @ (places["front"] - places["rear"]), 1, 1.4 * SIGMA_M)
    for name, text in texts.items():
        (folder / f"{name}.pos").write_text(text)
    return folder


def test_a_layout_is_calibrated_written_and_read_back(files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Table, TOML, picture; floats and wrong fixes left out and told; the TOML is a layout again."""
    words = [f"{name}={files / name}.pos" for name in TRUTH]
    out, plot = tmp_path / "layout.toml", tmp_path / "layout.png"
    assert run(["antennas", "calibrate", *words, "--name", "frame", "--out", str(out), "--plot", str(plot)]) == 0
    shown = capsys.readouterr()
    counts = re.search(r"instants: (\d+) of 115 used; left out (\d+) by distances, 0 by chi-square; (\d+) lost an antenna", shown.out)
    assert counts is not None, shown.out
    used, dropped, lost = map(int, counts.groups())
    assert (used + dropped, dropped + lost) == (115, 6), (
        "six wrong fixes; where only two of three distances show it, the whole instant goes"
    )
    assert "rear.pos: left out: 5 not fixed" in shown.err
    assert plot.read_bytes().startswith(b"\x89PNG")
    layout = read_layouts(out)["frame"]
    assert layout.names == tuple(TRUTH)
    found, axes = layout.positions_m, np.array(list(TRUTH.values()))
    between = np.linalg.norm(found[:, None] - found[None], axis=2)
    assert between == pytest.approx(np.linalg.norm(axes[:, None] - axes[None], axis=2), abs=0.003)
    assert run(["antennas", "calibrate", *words, "--out", str(out)]) == EXIT_USAGE
    assert "--force" in capsys.readouterr().err


def test_a_mounting_turns_the_layout_into_the_vehicle(files: Path, capsys: pytest.CaptureFixture[str]):
    """Azimuth and origin are told, mean tilt is taken out; JSON has the joint covariance."""
    words = [f"{name}={files / name}.pos" for name in TRUTH]
    assert run(["antennas", "calibrate", *words, "--azimuth", "90", "--level", "--offset=0.1,0,-1.5", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    rear, front = found["positions_m"][:2]
    assert rear == pytest.approx([0.1, 0.0, -1.5], abs=1e-9)
    assert np.subtract(front, rear) == pytest.approx([-1.2 * np.sin(0.0), 1.2 * np.cos(0.04), -1.2 * np.sin(0.04)], abs=0.006)
    assert np.shape(found["covariance_m2"]) == (12, 12)


def test_a_baseline_gives_a_length(files: Path, capsys: pytest.CaptureFixture[str]):
    assert run(["antennas", "calibrate", f"rear-front={files / 'rear-front.pos'}", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["positions_m"][1][0] == pytest.approx(1.2, abs=5.0 * found["sigmas_m"][1][0])
    assert "elevation" in found["notes"][0]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("calibrate",), "two or more are needed"),
        (("calibrate", "rear.pos"), "rtkmesh: rear.pos: say NAME=... for positions"),
        (("calibrate", "a=nothing.pos"), "No such file"),
        (("calibrate", "rear={}/rear-front.pos"), "say FROM-TO=FILE (it holds baselines)"),
        (("calibrate", "rear-front={}/rear.pos"), "say NAME=FILE (it holds positions)"),
        (("calibrate", "--rover", "a=x.ubx"), "recordings of two antennas"),
        (("calibrate", "--offset", "1,2"), "three numbers"),
        (("design",), "a layout is needed"),
        (("design", "--preset", "squre:1"), "--preset squre:1: there is no layout 'squre'; did you mean 'square'?"),
        (("design", "--preset", "square:wide"), "the size in metres"),
        (("design", "--antenna", "a=1,2"), "--antenna a: 1,2: three numbers"),
        (("design", "--antenna", "a=1,2,3", "--antenna", "1,2,3"), "--antenna 1,2,3: say NAME=F,R,D"),
        (("design", "--preset", "square:1", "--sigma-vertical", "0"), "--sigma-vertical: metres"),
        (("design", "--preset", "square:1", "--power", "2"), "probabilities"),
        (("design", "nothing.toml"), "No such file"),
    ],
)
def test_wrong_usage_is_told(files: Path, words: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str]):
    assert run(["antennas", *(word.format(files) for word in words)]) == EXIT_USAGE
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[attitude.a.antennas.x]\nposition_m = [1, 2]", "[attitude.a.antennas.x] position_m: three numbers"),
        ("[attitude.a.antennas.x]\nposition_m = [1, 2, 3]\nsigma_m = ['a']", "[attitude.a.antennas.x] sigma_m"),
        ("attitude = 3", "no antennas"),
        ("[attitude.a]\nantennas = {}", "has no antenna"),
        ("[", "layout.toml: "),
    ],
)
def test_wrong_layout_files_are_told(tmp_path: Path, text: str, said: str, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "layout.toml"
    path.write_text(text)
    assert run(["antennas", "design", str(path)]) == EXIT_USAGE
    assert said in capsys.readouterr().err


def test_designs_stand_side_by_side(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Files, single antennas, presets; warnings; figures for programs without NaN; a picture."""
    file, plot = tmp_path / "l.toml", tmp_path / "l.svg"
    file.write_text(
        "[attitude.boat.antennas.a]\nposition_m = [0, 0, 0]\n[attitude.boat.antennas.b]\nposition_m = [1, 0, 0]\nsigma_m = 0.01\n"
    )
    words = [
        str(file),
        "--antenna",
        "x=0,0,0",
        "--antenna",
        "y=1,0,0",
        "--antenna",
        "z=2,0,0",
        "--preset",
        "right-angle:1",
        "--preset",
        "square:1",
    ]
    assert run(["antennas", "design", *words, "--sigma-vertical", "0.01", "--plot", str(plot)]) == 0
    shown = capsys.readouterr().out
    assert "0.496" in shown
    assert "0.405" in shown
    assert "boat: two antennas" in shown
    assert "antennas: the antennas are on one line" in shown
    assert "right-angle:1: 74.5 degrees" in shown
    assert "<svg" in plot.read_text()
    assert run(["antennas", "design", *words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["boat"]["whole"]["roll_rad"] is None
    assert found["square:1"]["whole"]["redundancy"] == 6
    assert run(["antennas", "design", "--preset", "list"]) == 0
    assert "cube-corner" in capsys.readouterr().out


def test_names_that_toml_does_not_take_bare_are_quoted(files: Path, capsys: pytest.CaptureFixture[str]):
    words = [f"{name}={files / file}.pos" for name, file in (("rear left", "rear"), ("7.b", "front"))]
    assert run(["antennas", "calibrate", *words, "--quiet"]) == 0
    out = capsys.readouterr().out
    assert set(tomllib.loads(out[out.index("# rtkmesh") :])["attitude"]["attitude"]["antennas"]) == {"rear left", "7.b"}


def message(tow_s: float, rng: np.random.Generator) -> SolutionMessage:
    """A fixed baseline of 1.2 m that turns."""
    of: dict[Any, Any] = {int: 0, float: 0.0, str: ""}
    blank = {f.name: of.get(f.type, (nan,) * (9 if "cov" in f.name else 3)) for f in msgspec.structs.fields(SolutionMessage) if f.required}
    vector = rotation_of_angles(tow_s, 0.0, 0.0) @ [1.2, 0.0, 0.0] + rng.normal(0.0, SIGMA_M, 3)
    cov = tuple((SIGMA_M**2 * np.eye(3)).ravel().tolist())
    return SolutionMessage(
        **blank | {"week": 2232, "tow_s": tow_s, "status": 1, "baseline_enu_m": tuple(vector.tolist()), "baseline_cov_enu_m2": cov}
    )


def test_running_solvers_are_listened_to(site: Any, capsys: pytest.CaptureFixture[str]):
    """Over real Zenoh; a solver that says nothing is told."""
    over, rng = threading.Event(), np.random.default_rng(4)

    def publish() -> None:
        with site.bus("heading_rtk") as bus:
            for epoch in range(10_000):
                bus.publish(SOL, message(0.2 * epoch, rng))
                if over.wait(0.01):
                    return

    publisher = threading.Thread(target=publish)
    publisher.start()
    try:
        found = run(["antennas", "calibrate", "--live", "a-b=heading_rtk", "--seconds", "2", "--connect", site.endpoint, "--json"])
        length = json.loads(capsys.readouterr().out)["positions_m"][1][0]
        silent = run(["antennas", "calibrate", "--live", "a-b=other_rtk", "--seconds", "0.2", "--connect", site.endpoint])
    finally:
        over.set()
        publisher.join()
    assert (found, silent) == (0, EXIT_USAGE)
    assert length == pytest.approx(1.2, abs=0.003)
    assert "no solutions within 0.2 s from other_rtk" in capsys.readouterr().err
