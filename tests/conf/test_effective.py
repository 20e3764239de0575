"""What a configuration means, where it comes from, and what differs between two; secrets are never shown."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from rtkmesh_services.cli.main import run
from rtkmesh_services.conf.effective import settings_of

SECRET = "pa:ss@word"
TOML = f"""\
[ingest.rover]
source = "tcp://127.0.0.1:5000"

[ingest.base]
source = "ntrip://me:{SECRET}@c.example:2101/ROOF?gga=on"
fallback = ["ntrip://me:${{BASE_PASSWORD}}@d.example/ROOF"]

[solver.rtk]
rover = "rover"
base = "base"
elevation_mask_deg = 10
ambiguity = {{ ratio = 2.5 }}

[output.caster]
target = "ntrip-caster://127.0.0.1:2101"
mounts = {{ ROOF = "base" }}
users = {{ ann = "{SECRET}", bob = "${{BOBS}}" }}
"""


@pytest.fixture
def toml(tmp_path: Path) -> Path:
    path = tmp_path / "a.toml"
    path.write_text(TOML)
    return path


def test_every_value_has_its_origin(toml: Path):
    """Lines of the file, defaults of the table, the engine's own; the environment need not have the secrets."""
    settings = settings_of(toml)
    expected = {
        "solver.rtk.elevation_mask_deg": (10.0, "line 11"),
        "solver.rtk.ambiguity.ratio": (2.5, "line 12"),
        "solver.rtk.ambiguity.mode": ("continuous", "default"),
        "solver.rtk.noise.code_ratio": (150.0, "default"),
        "solver.rtk.max_age_s": (30.0, "default"),
        "ingest.base.source": ("ntrip://me:***@c.example:2101/ROOF?gga=on", "line 5"),
        "ingest.base.fallback": (["ntrip://me:${BASE_PASSWORD}@d.example/ROOF"], "line 6"),
        "output.caster.users.ann": ("***", "line 17"),
        "output.caster.users.bob": ("${BOBS}", "line 17"),
        "hub.enabled": (True, "default"),
    }
    assert {key: (settings[key].value, settings[key].origin) for key in expected} == expected


def test_of_a_conf_file_too(rtkrcv: Callable[..., bytes], tmp_path: Path):
    """The line of the key that a value comes from."""
    path = tmp_path / "a.conf"
    path.write_bytes(rtkrcv())
    settings = settings_of(path)
    line = 1 + next(k for k, text in enumerate(rtkrcv().decode().splitlines()) if text.startswith("pos2-arthres "))
    assert (settings["solver.rtk.ambiguity.ratio"].value, settings["solver.rtk.ambiguity.ratio"].origin) == (2.5, f"line {line}")
    assert settings["ingest.base.source"].value.startswith("ntrip://ann:${BASE_PASSWORD}@")


def test_the_commands_show_no_secret(toml: Path, capsys: pytest.CaptureFixture[str]):
    """Neither show nor diff nor export of what is not asked for; both forms."""
    for words in (["show"], ["show", "--json"], ["show", "--solver", "rtk"], ["diff", str(toml)]):
        assert run(["conf", words[0], str(toml), *words[1:]]) == 0
    shown = capsys.readouterr()
    assert SECRET not in shown.out + shown.err
    assert "solver.rtk.elevation_mask_deg" in shown.out
    assert run(["conf", "show", str(toml), "--solver", "rt"]) == 2


def test_differences_are_of_meaning(toml: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Defaults that are said, order and ids make none; another value makes one."""
    other = tmp_path / "b.toml"
    text = TOML.replace("solver.rtk", "solver.mine").replace("elevation_mask_deg = 10", "elevation_mask_deg = 10.0\nmax_age_s = 30")
    other.write_text(text)
    assert run(["conf", "diff", str(toml), str(other)]) == 0
    other.write_text(text.replace("2.5", "3"))
    assert run(["conf", "diff", str(toml), str(other), "--json"]) == 1
    (row,) = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (row["key"], row["one"]["value"], row["other"]["value"]) == ("solver.ambiguity.ratio", 2.5, 3.0)


def test_conf_and_its_import_are_the_same(rtkrcv: Callable[..., bytes], tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """A .conf file against the deployment that was made of it: in any mix of kinds."""
    conf, out = tmp_path / "a.conf", tmp_path / "a.toml"
    conf.write_bytes(rtkrcv())
    assert run(["conf", "import", str(conf), "--out", str(out)]) == 0
    assert run(["conf", "diff", str(conf), str(out)]) == 0
    back = tmp_path / "back.conf"
    assert run(["conf", "export", str(out), "--out", str(back)]) == 0
    capsys.readouterr()
    run(["conf", "diff", str(conf), str(back)])
    lost = {line for line in capsys.readouterr().out.splitlines() if line and line[0] != " "}
    assert not {key for key in lost if key.startswith("solver")}


def test_a_file_of_one_solver_is_compared_by_its_solver(toml: Path, tmp_path: Path):
    """[solver] alone against a deployment."""
    alone = tmp_path / "s.toml"
    alone.write_text('[solver]\nrover = "rover"\nbase = "base"\nelevation_mask_deg = 10\nambiguity = { ratio = 2.5 }\n')
    assert run(["conf", "diff", str(toml), str(alone)]) == 0
    assert run(["conf", "export", str(alone)]) == 0
