"""Faults of [attitude.ID] are said with line, key and what would be right; layouts come from files, too."""

from pathlib import Path

import numpy as np
import pytest

from rtkmesh.attitude.rigid_body import Layout
from rtkmesh.rtk.options import IntegrityOptions
from rtkmesh_schemas.errors import ConfigError
from rtkmesh_services.attitude.body import layout_of
from rtkmesh_services.cli.antenna_layouts import layout_toml, read_layouts
from rtkmesh_services.runtime.attitude_checks import SOLVER_RISK, notes_on
from rtkmesh_services.runtime.configuration import load_deployment, parse_deployment

FILE = """
[ingest.rear]
source = "sim://boat/rover"
[ingest.front]
source = "sim://boat/heading"
[ingest.right]
source = "sim://boat/starboard"
[ingest.station]
source = "sim://boat/base"
[solver.along]
rover = "front"
base = "rear"
mode = "moving-base"
baseline_length_m = 2.0
[solver.place]
rover = "right"
base = "station"
[attitude.boat]
solvers = ["along"]
positions = ["place"]
[attitude.boat.antennas]
rear = { position_m = [0.0, 0.0, 0.0], sigma_m = 0.002 }
front = { position_m = [2.0, 0.0, 0.0], sigma_m = [0.001, 0.002, 0.003] }
right = { position_m = [0.0, 1.2, 0.0] }
"""


def test_a_right_file_has_no_fault() -> None:
    deployment = parse_deployment(FILE, "x.toml")
    table = deployment.attitude["boat"]
    assert (table.sources, table.antennas["front"].sigmas_m) == (("along", "place"), (0.001, 0.002, 0.003))
    assert list(notes_on("boat", table, deployment)) == []


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ('solvers = ["along"]', 'solvers = ["alng"]', "x.toml:19: [attitude.boat] solvers: no [solver.alng]; did you mean 'along'?"),
        ('positions = ["place"]', 'positions = ["along"]', "x.toml:20: [attitude.boat] positions: [solver.along] is of mode 'moving-base'"),
        ('solvers = ["along"]', 'solvers = ["place"]', "x.toml:19: [attitude.boat] solvers: [solver.place] is of mode 'kinematic'"),
        ("front = {", "fornt = {", "write [attitude.boat.antennas.front]; did you mean 'fornt'?"),
        ("front = {", "fornt = {", "no [ingest.fornt], whose antenna this would be; did you mean 'front'?"),
        ("[2.0, 0.0, 0.0]", "[1.7, 0.0, 0.0]", "[solver.along] has baseline_length_m = 2.0, the places of its antennas give 1.700 m"),
        ("[2.0, 0.0, 0.0]", "[0.001, 0.0, 0.0]", "antennas: 'rear' and 'front' are at one place"),
        ("sigma_m = 0.002", "sigma_m = -1.0", "sigma_m of 'rear' must be 0 to 10 m"),
        ("sigma_m = 0.002", "sigma = 0.002", "[attitude.boat.antennas.rear] unknown key 'sigma'; did you mean 'sigma_m'?"),
        ('positions = ["place"]', "mounting_deg = 90.0", "mounting_deg and the places of antennas: say it by the places"),
        ('positions = ["place"]', 'imu = { key = "a/b" }', "imu is for a filter: write [attitude.boat.filter]"),
        ('positions = ["place"]', 'filter = { publish = "gyro" }', "filter: publish = 'gyro' needs [attitude.boat.imu]"),
        ("[attitude.boat]", '[attitude.boat]\ncourse = { position = "place" }', "course is for a filter: write"),
        ("[attitude.boat]", '[attitude.boat]\ncourse = { position = "plaice" }', "'plaice' is none of its positions; did you mean"),
        ('positions = ["place"]', 'headings = { rare = { } }', "[attitude.boat] headings: no [ingest.rare]; did you mean 'rear'?"),
        ('positions = ["place"]', 'headings = { rear = { antennas = ["rear", "left"] } }', "of antenna 'left', which has no place"),
        ('solvers = ["along"]\npositions = ["place"]', "", "x.toml:18: [attitude.boat] has no 'solver', 'solvers', 'positions'"),
        ('positions = ["place"]', 'layout = "none.toml"', "[attitude.boat] layout: none.toml: No such file"),
        ('positions = ["place"]', 'layout = "../x.toml"', "[attitude.boat] layout: ../x.toml: "),
    ],
)  # fmt: skip
def test_faults_are_said(old: str, new: str, expected: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_deployment(FILE.replace(old, new, 1), "x.toml")
    assert expected in str(caught.value)


def test_antennas_on_one_line_are_a_note() -> None:
    deployment = parse_deployment(FILE.replace("[0.0, 1.2, 0.0]", "[1.0, 0.0005, 0.0]"), "x.toml")
    notes = list(notes_on("boat", deployment.attitude["boat"], deployment))
    assert notes == ["[attitude.boat] its 3 antennas are on one line: the tilt about it is not seen"]


def test_a_length_that_a_solver_does_not_know_is_a_note() -> None:
    deployment = parse_deployment(FILE.replace("baseline_length_m = 2.0", ""), "x.toml")
    notes = list(notes_on("boat", deployment.attitude["boat"], deployment))
    assert notes == ["[solver.along] fixes sooner with 'baseline_length_m = 2.000', which [attitude.boat] knows"]


@pytest.mark.parametrize(("risk", "levels"), [("1e-3", "of a risk of 1e-05"), ("1e-6", "infinite"), ("1e-5", "")])
def test_a_solver_with_another_risk_is_told(risk: str, levels: str) -> None:
    """Levels of two antennas are those of the solver of their baseline."""
    assert IntegrityOptions().risk == SOLVER_RISK
    deployment = parse_deployment(FILE + f"[attitude.boat.integrity]\nrisk = {risk}\n", "boat.toml")
    notes = list(notes_on("boat", deployment.attitude["boat"], deployment))
    assert [note.partition("antennas are ")[2] for note in notes] == ([levels] if levels else [])


@pytest.mark.parametrize("head", ["attitude.boat.antennas", "attitude.calibrated.antennas", "antennas"])
def test_a_layout_file_has_the_places(tmp_path: Path, head: str) -> None:
    """As `rtkmesh antennas calibrate` writes them; what the deployment says itself goes before it."""
    rows = "".join(f"[{head}.{name}]\nposition_m = [{x}, {y}, 0.0]\n" for name, x, y in (("rear", 0, 0), ("front", 2, 0), ("right", 9, 9)))
    (tmp_path / "layout.toml").write_text(rows)
    kept = FILE[: FILE.index("[attitude.boat.antennas]")]
    own = "[attitude.boat.antennas.right]\nposition_m = [0.0, 1.2, 0.0]\n"
    (tmp_path / "x.toml").write_text(kept.replace('positions = ["place"]', 'positions = ["place"]\nlayout = "layout.toml"') + own)
    antennas = load_deployment(tmp_path / "x.toml").attitude["boat"].antennas
    assert {name: place.position_m[:2] for name, place in antennas.items()} == {"rear": (0, 0), "front": (2, 0), "right": (0, 1.2)}


def test_the_covariance_of_a_layout_file_is_that_of_the_service(tmp_path: Path) -> None:
    """A calibrated layout keeps what its antennas have in common on its way through the files into the rigid body."""
    root = np.random.default_rng(1).normal(0.0, 2e-3, (9, 9))
    known = Layout(("rear", "front", "right"), np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 1.2, 0.0]]), root @ root.T)
    (tmp_path / "layout.toml").write_text(layout_toml(known, "boat", ["calibrated"]))
    kept = FILE[: FILE.index("[attitude.boat.antennas]")]
    (tmp_path / "x.toml").write_text(kept.replace('positions = ["place"]', 'positions = ["place"]\nlayout = "layout.toml"'))
    found = layout_of(load_deployment(tmp_path / "x.toml").attitude["boat"])
    assert found.cov_m2 is not None
    np.testing.assert_allclose(found.cov_m2, root @ root.T, atol=1e-8)
    again = read_layouts(tmp_path / "layout.toml")["boat"].cov_m2
    np.testing.assert_allclose(again, found.cov_m2)  # pyright: ignore[reportArgumentType]  it has one


@pytest.mark.parametrize(
    ("told", "expected"),
    [
        ("{ frond = [0, 0, 0, 0, 0, 0, 0, 0, 0] }", "covariance_m2 of 'rear' with 'frond', which is none; did you mean 'front'"),
        ("{ rear = [-1e-6, 0, 0, 0, 1e-6, 0, 0, 0, 1e-6] }", "covariance_m2 of 'rear' has negative variances"),
        ("{ rear = [1e-6, 2e-6, 0, 2e-6, 1e-6, 0, 0, 0, 1e-6] }", "covariance_m2 of 'rear' with 'rear' is larger than their variances"),
        ("{ rear = [1e-6, 0, 0] }", "covariance_m2"),
    ],
)
def test_covariances_that_are_none_are_told(told: str, expected: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_deployment(FILE.replace("sigma_m = 0.002", f"covariance_m2 = {told}", 1), "x.toml")
    assert expected in str(caught.value)


def test_a_fault_of_a_layout_file_names_that_file(tmp_path: Path) -> None:
    (tmp_path / "layout.toml").write_text("[antennas.rear]\nposition = [0.0, 0.0, 0.0]\n")
    (tmp_path / "x.toml").write_text(FILE.replace('positions = ["place"]', 'layout = "layout.toml"'))
    with pytest.raises(ConfigError, match=r"layout.toml:2: \[antennas.rear\] unknown key 'position'; did you mean 'position_m'"):
        load_deployment(tmp_path / "x.toml")
