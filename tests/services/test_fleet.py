"""From a deployment file to the table of its processes."""

import re
from pathlib import Path

import pytest

from rtkmesh_schemas.keys import Role
from rtkmesh_services.cli.demo import deployment_text
from rtkmesh_services.control.fleet import ONE_THREAD, LaunchOptions, clean_environment, restarts_between, specs_of
from rtkmesh_services.runtime.configuration import load_site, parse_deployment
from rtkmesh_services.runtime.shipped import config_path

CONFIG = Path(__file__).resolve().parents[2] / "config"
TEXT = """
[ingest.rover]
source = "tcp://127.0.0.1:2101"
[ingest.base]
source = "tcp://127.0.0.1:2102"
[solver.rtk]
rover = "rover"
base = "base"
[solver.alone]
rover = "rover"
mode = "single"
[ros2.bridge]
python = "/opt/ros/python"
"""


def specs(text: str, **options: str):
    return specs_of(parse_deployment(text, "test.toml"), LaunchOptions(Path("/x/test.toml"), python="/py", **options))


def by_id(text: str, **options: str):
    return {spec.id: spec for spec in specs(text, **options)}


def test_every_process_of_the_file_is_there_once_and_the_hub_first() -> None:
    assert [(spec.id, spec.role) for spec in specs(TEXT)] == [
        ("hub", Role.HUB),
        ("rover", Role.INGEST),
        ("base", Role.INGEST),
        ("rtk", Role.SOLVER),
        ("alone", Role.SOLVER),
        ("bridge", Role.ROS2),
    ]


def test_without_a_hub_of_ours_none_is_started() -> None:
    assert "hub" not in by_id("[hub]\nenabled = false\n" + TEXT)


def test_argv_runs_the_role_with_the_file_and_the_speed() -> None:
    found = by_id(TEXT, speed="max")
    assert found["rtk"].argv == (
        *("/py", "-m", "rtkmesh_services.cli.main", "run", "solver", "--id", "rtk", "--config", "/x/test.toml", "--speed", "max"),
    )
    assert "--speed" not in found["hub"].argv
    assert found["bridge"].argv[0] == "/opt/ros/python"


def test_environment_is_scrubbed_and_single_threaded() -> None:
    inherited = {
        "PATH": "/bin",
        "PYTHONPATH": "/opt/ros/lib",
        "PYTHONINSPECT": "1",
        "LD_PRELOAD": "x.so",
        "RTKMESH_DATA": "/d",
        "OMP_NUM_THREADS": "8",
    }
    found = clean_environment(inherited, Role.SOLVER)
    assert {"PATH", "RTKMESH_DATA"} <= set(found)
    assert not {"PYTHONPATH", "PYTHONINSPECT", "LD_PRELOAD"} & set(found)
    assert all(found[name] == "1" for name in ONE_THREAD)
    assert clean_environment(inherited, Role.ROS2)["PYTHONPATH"] == "/opt/ros/lib"


@pytest.mark.parametrize(
    ("old", "new", "restarted"),
    [
        ('source = "tcp://127.0.0.1:2102"', 'source = "tcp://127.0.0.1:9"', ["base", "rtk"]),
        ('source = "tcp://127.0.0.1:2101"', 'source = "tcp://127.0.0.1:9"', ["rover", "rtk", "alone"]),
        ('mode = "single"', 'mode = "single"\nelevation_mask_deg = 5.0', ["alone"]),
        ('mode = "single"', 'mode   =   "single"  # a comment', []),
    ],
)
def test_a_change_restarts_the_process_and_those_that_depend_on_it(old: str, new: str, restarted: list[str]) -> None:
    assert old in TEXT
    removed, added, changed = restarts_between(specs(TEXT), specs(TEXT.replace(old, new)))
    assert (removed, added, [spec.id for spec in changed]) == ([], [], restarted)


def test_added_removed_and_a_process_that_changed_its_role() -> None:
    other = TEXT.replace('[solver.alone]\nrover = "rover"\nmode = "single"', "[monitor.alone]") + "[monitor.more]\n"
    removed, added, changed = restarts_between(specs(TEXT), specs(other))
    assert (removed, [spec.id for spec in added], changed) == (["alone"], ["alone", "more"], [])


@pytest.mark.parametrize("file", sorted(CONFIG.glob("*.toml")), ids=lambda path: path.name)
def test_shipped_deployments_are_right(file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in re.findall(r"\$\{(\w+)\}", file.read_text()):
        monkeypatch.setenv(name, "secret")
    site = load_site(file, tmp_path)
    found = specs_of(site.deployment, LaunchOptions(file))
    assert len(found) >= 3


def test_demo_takes_rate_and_seed_and_is_one_deployment_of_eight_processes() -> None:
    deployment = parse_deployment(deployment_text(2.5, 7), "demo.toml")
    assert {table.source.partition("?")[2] for table in deployment.ingest.values()} == {"rate=2.5&seed=7"}
    assert len(specs_of(deployment, LaunchOptions(config_path("demo.toml")))) == 7  # and control, their parent
