"""Deployment files: every fault is named by file, line, key and the nearest right name."""

import os
import tomllib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtkmesh.errors import OptionError
from rtkmesh.rtk import options
from rtkmesh.rtk.options import AmbiguityOptions, RtkOptions
from rtkmesh_schemas.config import LEAST_AMBIGUITIES
from rtkmesh_schemas.errors import ConfigError
from rtkmesh_schemas.keys import Role
from rtkmesh_services.mapping.options import rtk_options, session_options
from rtkmesh_services.runtime.configuration import (
    ConfigErrors,
    find_data_folder,
    load_deployment,
    load_site,
    load_solver_table,
    parse_deployment,
    require_id,
)
from rtkmesh_services.runtime.toml_lines import lines_of

GOOD = """\
[deployment]
name = "test"
log_level = "info"

[hub]
listen = ["tcp/127.0.0.1:7547"]

[ingest.rover]
source = "file://rover.ubx?speed=1"

[ingest.base]
source = "tcp://localhost:5015"
position_ecef_m = [-3817680.727, 3562839.522, 3650159.241]

[solver.rtk]
rover = "rover"
base = "base"
mode = "kinematic"
max_age_s = 30
sync = { max_wait_s = 0.5, matched_only = true }

[solver.rtk.ambiguity]
mode = "continuous"
ratio = 3.0

[solver.alone]
rover = "rover"
mode = "single"

[attitude.heading]
solver = "rtk"
length_m = 1.0
"""


def errors_of(text: str) -> list[ConfigError]:
    """Return the faults of a text."""
    try:
        parse_deployment(text, "f.toml", None)
    except ConfigErrors as error:
        return error.errors
    return []


def test_a_good_file_is_read():
    """Tables become structs, nested ones too."""
    deployment = parse_deployment(GOOD, "f.toml")
    assert deployment.solver["rtk"].sync.matched_only
    assert deployment.solver["rtk"].ambiguity.ratio == 3.0
    assert deployment.ingest["base"].position_ecef_m == (-3817680.727, 3562839.522, 3650159.241)
    assert deployment.solver["alone"].base == ""


# (what is replaced, by what, the line of the fault, words of its message)
MISTAKES = [
    ("[deployment]", "[deploiment]", 1, ["[deploiment]", "did you mean 'deployment'"]),
    ("[solver.rtk]", "[slover.rtk]", 15, ["[slover]", "did you mean 'solver'"]),
    ("log_level", "loglevel", 3, ["[deployment] unknown key 'loglevel'", "'log_level'"]),
    ('"info"', '"inof"', 3, ["log_level", "debug, info, warning, error", "did you mean 'info'"]),
    ('"info"', "3", 3, ["log_level"]),
    ('name = "test"', "name = 1", 2, ["[deployment] name", "expected text", "whole number"]),
    ('["tcp/127.0.0.1:7547"]', '"tcp/127.0.0.1:7547"', 6, ["[hub] listen", "a list"]),
    ("127.0.0.1", "0.0.0.0", 6, ["loopback", "insecure = true"]),
    ("127.0.0.1", "192.168.1.5", 6, ["loopback"]),
    ("source = \"file://rover.ubx?speed=1\"", "", 8, ["[ingest.rover] has no 'source'"]),
    ("source = \"file://rover.ubx?speed=1\"", "sorce = 'x'", 9, ["unknown key 'sorce'", "did you mean 'source'"]),
    ("[ingest.rover]", "[ingest.Rover]", 8, ["'Rover' is no id"]),
    ("[ingest.rover]", "[ingest.flockwave]", 8, ["'flockwave' is no id"]),
    ("[ingest.rover]", "[ingest.control]", 8, ["taken by control"]),
    ("[ingest.rover]", "[ingest.hub]", 8, ["taken by hub"]),
    ("[ingest.base]", "[ingest.rtk]", 15, ["the id 'rtk' is taken by [ingest.rtk]"]),
    ("[ingest.rover]", "[ingest]", 9, ["[ingest.source]"]),
    ("-3817680.727", "-38176800.727", 13, ["[ingest.base] position_ecef_m[0]: expected a number >= -10000000.0"]),
    (", 3650159.241", "", 13, ["position_ecef_m", "length 3"]),
    ("-3817680.727", "nan", 13, ["nan is no number"]),
    ('rover = "rover"', 'rover = "rovr"', 16, ["[solver.rtk] rover: no [ingest.rovr]", "did you mean 'rover'"]),
    ('base = "base"', 'base = "zzz"', 17, ["[solver.rtk] base: no [ingest.zzz]", "rover, base"]),
    ('base = "base"', "", 15, ["[solver.rtk] has no 'base'", "kinematic"]),
    ('"kinematic"', '"kinematc"', 18, ["mode", "moving-base", "did you mean 'kinematic'"]),
    ("max_age_s", "maxage", 19, ["unknown key 'maxage'", "did you mean 'max_age_s'"]),
    ("= 30", "= -1", 19, ["[solver.rtk] max_age_s", "> 0.0"]),
    ("= 30", "= inf", 19, ["inf is no number"]),
    ("= 30", '= "30"', 19, ["max_age_s", "expected a number", "text"]),
    ("= 30", "= 30 s", 19, ["no TOML"]),
    ("max_wait_s", "max_wait", 20, ["[solver.rtk.sync] unknown key 'max_wait'", "'max_wait_s'"]),
    ("0.5,", "99.0,", 20, ["[solver.rtk.sync] max_wait_s", "<= 60.0"]),
    ("matched_only = true", "interpolate = true", 20, ["[solver.rtk.sync] interpolate: [ingest.base] is live", "of recordings alone"]),
    ("matched_only = true", "matched_only = 1", 20, ["[solver.rtk.sync] matched_only", "true or false"]),
    ('"continuous"', '"continous"', 23, ["[solver.rtk.ambiguity] mode", "did you mean 'continuous'"]),
    ("ratio = 3.0", "ratoi = 3.0", 24, ["[solver.rtk.ambiguity] unknown key 'ratoi'", "'ratio'"]),
    ("ratio = 3.0", "minimum_ambiguities = 4", 24, ["[solver.rtk.ambiguity] minimum_ambiguities: fewer than 5", "'baseline_length_m'"]),
    ("ratio = 3.0", "failure_rate = 0.1\n[solver.rtk.integrity]\nenabled = false", 24, ["failure_rate needs [integrity] enabled"]),
    ("[solver.rtk.ambiguity]", "[solver.rtk.ambigity]", 22, ["[solver.rtk] unknown key 'ambigity'", "'ambiguity'"]),
    ('solver = "rtk"', 'solver = "rt"', 31, ["[attitude.heading] solver: no [solver.rt]", "did you mean 'rtk'"]),
    ("length_m = 1.0", "length_m = 0.0", 32, ["length_m", "> 0.0"]),
    ("length_m = 1.0", "solver = 1", 32, ["no TOML"]),
]  # fmt: skip


@pytest.mark.parametrize(("right", "wrong", "line", "words"), MISTAKES)
def test_a_mistake_is_named_with_its_line_and_the_right_name(right: str, wrong: str, line: int, words: list[str]):
    """Forty mistakes that people make: each is one message at the right line with what to write."""
    assert right in GOOD
    found = errors_of(GOOD.replace(right, wrong, 1))
    messages = [error for error in found if all(word in str(error) for word in words)]
    assert messages, [str(error) for error in found]
    assert messages[0].line == line
    assert str(messages[0]).startswith(f"f.toml:{line}: ")


def test_base_epochs_of_recordings_may_be_interpolated_if_the_base_stands():
    """Both sources are files; a moving base is refused."""
    replay = GOOD.replace("tcp://localhost:5015", "file://base.ubx").replace("matched_only = true", "interpolate = true")
    assert not errors_of(replay)
    assert session_options(parse_deployment(replay, "f.toml").solver["rtk"], replay=True).pairing.interpolate
    assert not session_options(parse_deployment(GOOD, "f.toml").solver["rtk"], replay=True).pairing.interpolate
    [error] = errors_of(replay.replace('"kinematic"', '"moving-base"'))
    assert (error.line, "a moving base is not where it was" in error.message) == (20, True)


def test_few_ambiguities_are_enough_where_the_length_is_known():
    """Of a moving base; the engine takes them too."""
    few = GOOD.replace("ratio = 3.0", "minimum_ambiguities = 4")
    known = few.replace("max_age_s = 30", "baseline_length_m = 1.0").replace('"kinematic"', '"moving-base"')
    assert errors_of(few)
    assert not errors_of(known)
    assert rtk_options(parse_deployment(known, "f.toml").solver["rtk"]).ambiguity.minimum_ambiguities == 4
    assert LEAST_AMBIGUITIES == options.LEAST_AMBIGUITIES
    with pytest.raises(OptionError, match="fewer than 5 are believed only with baseline_length_m"):
        RtkOptions(ambiguity=AmbiguityOptions(minimum_ambiguities=4))


def test_all_faults_are_told_at_once():
    """One run, all faults, in the order of lines."""
    text = (
        GOOD.replace("log_level", "loglevel").replace('"kinematic"', '"kin"').replace("ratio = 3.0", "ratio = 0.1").replace("= 30", "= nan")
    )
    assert [error.line for error in errors_of(text)] == [3, 18, 19, 24]


def test_environment_and_data_are_filled_in(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Secrets come from the environment, recordings from their folder; neither shows in the hash."""
    monkeypatch.setenv("CASTER_PASSWORD", "hunter2")
    file = tmp_path / "d.toml"
    file.write_text('[ingest.a]\nsource = "tcp://u:${CASTER_PASSWORD}@h:1"\n[ingest.b]\nsource = "file://{data}/x.ubx"\n')
    site = load_site(file, tmp_path)
    assert site.deployment.ingest["a"].source == "tcp://u:hunter2@h:1"
    assert site.deployment.ingest["b"].source == f"file://{tmp_path}/x.ubx"
    monkeypatch.setenv("CASTER_PASSWORD", "other")
    assert load_site(file, tmp_path).hash == site.hash


def test_a_missing_reference_is_named(monkeypatch: pytest.MonkeyPatch):
    """An unset variable and an unknown data folder are faults of the line that uses them."""
    monkeypatch.delenv("NOT_SET_HERE", raising=False)
    [error] = errors_of('[ingest.a]\nsource = "tcp://${NOT_SET_HERE}"\n')
    assert (error.line, "NOT_SET_HERE" in error.message) == (2, True)
    [error] = errors_of('[ingest.a]\n\nsource = "file://{data}/x"\n')
    assert (error.line, "--data" in error.message) == (3, True)


def test_data_folder_by_argument_then_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """--data wins over RTKMESH_DATA."""
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    monkeypatch.setenv("RTKMESH_DATA", str(tmp_path / "a"))
    assert find_data_folder() == tmp_path / "a"
    assert find_data_folder(tmp_path / "b") == tmp_path / "b"


def test_insecure_lets_the_hub_listen_elsewhere():
    """The flag says that it is meant."""
    assert errors_of('[hub]\nlisten = ["tcp/0.0.0.0:7547"]\ninsecure = true\n') == []


@pytest.mark.parametrize("content", [b"\xff\xfe", b"[a\n", b"a = 1 = 2", b"[deployment]\nname = 'a'\nname = 'b'\n"])
def test_what_is_no_toml_is_said_with_its_line(tmp_path: Path, content: bytes):
    """Syntax and encoding faults are ConfigErrors like all others."""
    file = tmp_path / "d.toml"
    file.write_bytes(content)
    with pytest.raises(ConfigErrors) as caught:
        load_deployment(file)
    assert caught.value.line in {1, 3}


def test_a_missing_or_huge_file_is_said(tmp_path: Path):
    """No file, a folder, a megabyte too much."""
    (tmp_path / "huge.toml").write_bytes(b"#" * ((1 << 20) + 1))
    for name, word in (("nothing.toml", "No such file"), ("", "directory"), ("huge.toml", "bytes")):
        with pytest.raises(ConfigErrors, match=word):
            load_deployment(tmp_path / name)


def test_an_id_that_is_not_in_the_file(tmp_path: Path):
    """``run solver --id rtl`` names the nearest."""
    (tmp_path / "d.toml").write_text(GOOD)
    site = load_site(tmp_path / "d.toml")
    require_id(site, Role.SOLVER, "rtk")
    require_id(site, Role.HUB, "hub")
    with pytest.raises(ConfigError, match=r"no \[solver.rtl\]; did you mean 'rtk'"):
        require_id(site, Role.SOLVER, "rtl")


@given(st.text(alphabet=st.sampled_from("[]{}=\"'.,#\\\n abc123-"), max_size=120))
def test_the_line_index_walks_any_toml(text: str):
    """Every key of every document that tomllib reads has a line within it."""
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return
    lines = lines_of(text)
    assert all((key,) in lines for key in raw)
    assert all(1 <= line <= text.count("\n") + 1 for line in lines.values())


def test_the_line_index_knows_all_forms():
    """Dotted and quoted keys, inline tables, arrays over lines, arrays of tables, strings with brackets and hashes."""
    text = """\
a.b."c d" = 1 # [x]
t = { p = "]", q = { r = 2 } }
l = [
  "#", # one
  [1, 2],
  { z = 3 },
]
m = '''
[no]
'''
[[row]]
v = 1
[row.sub]
w = 2
[[row]]
v = \"\"\"
[no]\\"
\"\"\"
e = 1
"""
    assert tomllib.loads(text)
    lines = lines_of(text)
    expected = {
        ("a", "b", "c d"): 1,
        ("t", "q", "r"): 2,
        ("l", "0"): 4,
        ("l", "1"): 5,
        ("l", "2", "z"): 6,
        ("m",): 8,
        ("row", "0", "v"): 12,
        ("row", "0", "sub", "w"): 14,
        ("row", "1", "v"): 16,
        ("row", "1", "e"): 19,
    }
    assert {path: lines.get(path) for path in expected} == expected
    assert ("no",) not in lines


SOLVER = '[solver]\nrover = "rover"\nbase = "base"\nelevation_mask_deg = 20\n'


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A configuration folder with good and evil things in it, and a secret beside it."""
    below = tmp_path / "config"
    (below / "sub").mkdir(parents=True)
    (tmp_path / "secret.toml").write_text(SOLVER)
    (below / "night.toml").write_text(SOLVER)
    (below / "sub" / "deep.toml").write_text(SOLVER)
    (below / "link.toml").symlink_to(tmp_path / "secret.toml")
    (below / "inner.toml").symlink_to("night.toml")
    (below / "out").symlink_to(tmp_path)
    os.mkfifo(below / "fifo.toml")
    (below / "huge.toml").write_text("#" * 70_000)
    (below / "wrong.toml").write_text(SOLVER.replace("elevation_mask_deg", "elmask"))
    (below / "two.toml").write_text(SOLVER + "[hub]\n")
    (below / "binary.toml").write_bytes(b"\xff")
    return below


@pytest.mark.parametrize("name", ["night.toml", "sub/deep.toml"])
def test_load_reads_below_the_configured_folder(folder: Path, name: str):
    """A plain name, or one in a folder below."""
    assert load_solver_table(name, folder).elevation_mask_deg == 20.0


@pytest.mark.parametrize(
    "name",
    [
        "../secret.toml",
        "sub/../../secret.toml",
        "/etc/passwd",
        "link.toml",
        "inner.toml",
        "out/secret.toml",
        "fifo.toml",
        "sub",
        "huge.toml",
        "",
        ".",
        "..",
        "nothing.toml",
        "night.toml\0",
        "/dev/zero",
        "a//b",
        "./night.toml",
        "%2e%2e/secret.toml",
        "night.toml\n",
        "x" * 5000,
        "binary.toml",
    ],
)
def test_load_reads_nothing_else(folder: Path, name: str):
    """No way out, no link, no device, no pipe, no giant: all are ConfigErrors, at once."""
    with pytest.raises(ConfigError) as caught:
        load_solver_table(name, folder)
    assert len(str(caught.value)) < 300


@given(st.text(max_size=30))
def test_no_name_raises_anything_else(name: str):
    """Any text is a file's name or a ConfigError."""
    with pytest.raises(ConfigError):
        load_solver_table(name, Path("/nonexistent"))


def test_load_names_faults_with_lines(folder: Path):
    """The same messages as for a deployment."""
    with pytest.raises(ConfigErrors, match=r"wrong.toml:4: \[solver\] unknown key 'elmask'; did you mean 'elevation_mask_deg'"):
        load_solver_table("wrong.toml", folder)
    with pytest.raises(ConfigErrors, match=r"two.toml:5: unknown table \[hub\]"):
        load_solver_table("two.toml", folder)


def test_receiver_options_are_checked_where_they_stand():
    """One clear error with the line and the nearest right name; those of RTKLIB pass as they are."""
    good = GOOD.replace("[ingest.base]", 'options = "-EPHALL -TADJ=0.1 -GL2L -MULTICODE"\n\n[ingest.base]')
    assert parse_deployment(good, "test.toml").ingest["rover"].options.startswith("-EPHALL")
    (error,) = errors_of(good.replace("-EPHALL", "-EPHAL"))
    assert error.message == "[ingest.rover] options: no receiver option '-EPHAL'; did you mean -EPHALL?"
    assert error.line == 11
