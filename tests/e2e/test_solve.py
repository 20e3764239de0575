"""``rtkmesh solve`` as users run it: flags, exit codes, output."""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from rtkmesh_services.cli.main import run

SET = "kanagawa_2021_078_60s"
TRUTH_ECEF_M = np.array([-3962108.673, 3381309.574, 3668678.638])  # data/README.md
BASE_ECEF_M = "-3959400.631,3385704.533,3667523.111"
BASE_LLH = "35.326681912,139.466071726,46.5007"


def arguments(data: Path, *more: str) -> list[str]:
    folder = data / SET
    files = ["--rover", f"{folder}/SEPT078M1.21O", "--base", f"{folder}/3034078M1.21O", "--nav", f"{folder}/SEPT078M.21P"]
    return ["solve", *files, "--systems", "GEJ", *more]


def rows(path: Path) -> list[list[str]]:
    return [line.split() for line in path.read_text().splitlines() if not line.startswith("%")]


@pytest.mark.e2e
@pytest.mark.data
def test_solves_to_centimetres(data: Path, tmp_path: Path) -> None:
    """A process solves the recording: fixes within 5 cm of the known position, a JSON summary, nothing on standard error."""
    out = tmp_path / "out.pos"
    command = [sys.executable, "-m", "rtkmesh_services.cli.main", *arguments(data)]
    options = [f"--base-ecef={BASE_ECEF_M}", "--format", "xyz", "--json", "--out", str(out)]
    done = subprocess.run([*command, *options], capture_output=True, text=True, timeout=240, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    summary = json.loads(done.stdout)
    assert summary["epochs"] == summary["solved"] == 60
    fixes = [row for row in rows(out) if row[5] == "1"]
    assert len(fixes) == round(summary["fix_pct"] * 0.6) >= 40
    errors_m = np.linalg.norm(np.array([[float(v) for v in row[2:5]] for row in fixes]) - TRUTH_ECEF_M, axis=1)
    assert np.percentile(errors_m, 95) < 0.05
    assert "ref pos   :  -3959400.6310   3385704.5330   3667523.1110" in out.read_text()


@pytest.mark.data
@pytest.mark.slow
def test_formats_agree(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The same run in three formats and two times; a base in degrees is the same base; the summary stands on standard error."""
    enu, llh = tmp_path / "enu.pos", tmp_path / "llh.pos"
    assert run(arguments(data, f"--base-ecef={BASE_ECEF_M}", "--format", "enu", "--out", str(enu))) == 0
    assert run(arguments(data, f"--base-llh={BASE_LLH}", "--time-form", "tow", "--out", str(llh), "--quiet")) == 0
    captured = capsys.readouterr()
    assert not captured.out
    assert captured.err.count("epochs") == 1
    assert len(rows(enu)) == len(rows(llh)) == 60
    first, other = rows(enu)[-1], rows(llh)[-1]
    assert [float(v) for v in first[2:5]] == pytest.approx([5100.213, 1404.253, 17.024], abs=0.1)
    assert [float(v) for v in other[2:4]] == pytest.approx([35.339325773, 139.522173121], abs=1e-6)
    assert (first[:2], other[:2]) == (["2021/03/19", "12:00:59.000"], ["2149", "475259.000"])


@pytest.mark.data
@pytest.mark.slow
def test_velocities_and_accelerations(data: Path, tmp_path: Path) -> None:
    """Of a receiver that stands: rtkrcv_ros's vel_enu, RTKLIB's columns and JSON say the same, with covariances in both frames."""
    paths = {name: tmp_path / name for name in ("vel_enu", "llh", "xyz", "json")}
    for name, path in paths.items():
        more = ["--velocity"] if name in ("llh", "xyz") else []
        assert run(arguments(data, f"--base-ecef={BASE_ECEF_M}", "--format", name, *more, "--out", str(path), "--quiet")) == 0
    told = [json.loads(line) for line in paths["json"].read_text().splitlines()]
    assert [len(rows(paths[name])) for name in ("vel_enu", "llh", "xyz")] == [len(told)] * 3 == [60] * 3
    assert "V_East(m/s)" in paths["vel_enu"].read_text()
    assert "vn(m/s)" in paths["llh"].read_text()
    assert "vx(m/s)" in paths["xyz"].read_text()
    last, llh, xyz, enu = told[-1], *(rows(paths[name])[-1] for name in ("llh", "xyz", "vel_enu"))
    east, north, up = last["velocity_enu_mps"]
    assert [float(v) for v in llh[15:18]] == pytest.approx([north, east, up], abs=1e-5)
    assert [float(v) for v in xyz[15:18]] == pytest.approx(last["velocity_ecef_mps"], abs=1e-5)
    assert [float(v) for v in enu[2:5]] == pytest.approx([east, north, up], abs=1e-3), "in the base's horizon, 5 km away"
    speeds_mps = [np.linalg.norm(one["velocity_ecef_mps"]) for one in told]
    assert 0.0 < np.median(speeds_mps) < 0.05
    for quantity in ("velocity_cov_{}_m2ps2", "acceleration_cov_{}_m2ps4", "position_cov_{}_m2"):
        ecef, local = (np.reshape(last[quantity.format(frame)], (3, 3)) for frame in ("ecef", "enu"))
        assert np.linalg.eigvalsh(ecef) == pytest.approx(np.linalg.eigvalsh(local), rel=1e-6)
        assert np.linalg.eigvalsh(local).min() > 0.0
        assert np.abs(local - np.diag(np.diag(local))).max() > 0.0
    assert np.linalg.norm(last["acceleration_ecef_mps2"]) == pytest.approx(np.linalg.norm(last["acceleration_enu_mps2"]))


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize("word", ["off", "instantaneous", "continuous", "fix-and-hold"])
def test_ways_with_ambiguities(data: Path, tmp_path: Path, word: str) -> None:
    """The header says which; without integers nothing is fixed, of each epoch alone nothing is remembered (grade 1)."""
    out = tmp_path / "out.json"
    arguments_ = arguments(data, f"--base-ecef={BASE_ECEF_M}", "--ambiguity", word, "--quiet")
    assert run([*arguments_, "--format", "json", "--out", str(out)]) == 0
    told = [json.loads(line) for line in out.read_text().splitlines()]
    grades = {one["grade"] for one in told if one["status_name"] == "FIX"}
    assert grades == {"off": set(), "instantaneous": {1}}.get(word, {1, 2, 3})
    pos = tmp_path / "out.pos"
    assert run([*arguments_, "--out", str(pos)]) == 0
    assert f"% amb res   : {word}\n" in pos.read_text()


@pytest.mark.e2e
@pytest.mark.data
def test_backward_and_combined(data: Path, tmp_path: Path) -> None:
    """Every direction writes the same epochs in rising order and says in the header which it is; combined tells of both."""
    command = [
        sys.executable,
        "-m",
        "rtkmesh_services.cli.main",
        *arguments(data),
        f"--base-ecef={BASE_ECEF_M}",
        "--format",
        "xyz",
        "--json",
    ]
    times: list[list[str]] = []
    for direction in ("forward", "backward", "combined"):
        out = tmp_path / f"{direction}.pos"
        options = ["--direction", direction, "--out", str(out)]
        done = subprocess.run([*command, *options], capture_output=True, text=True, timeout=240, check=False)
        assert (done.returncode, done.stderr) == (0, "")
        assert f"% solution  : {direction}\n" in out.read_text()
        times.append([row[1] for row in rows(out)])
        errors_m = np.linalg.norm(np.array([[float(v) for v in row[2:5]] for row in rows(out)]) - TRUTH_ECEF_M, axis=1)
        assert np.percentile(errors_m, 95) < 0.05
    summary = json.loads(done.stdout)
    assert times[0] == times[1] == times[2] == sorted(times[0])
    assert (summary["direction"], summary["epochs"], summary["combined"]) == ("combined", 60, {"agreed": 60})
    assert [part["epochs"] for part in summary["directions"].values()] == [60, 60]
    assert list(summary["directions"]) == ["forward", "backward"]


@pytest.mark.data
@pytest.mark.slow
def test_a_slow_base_is_interpolated(data: Path, tmp_path: Path) -> None:
    """One base epoch in fifteen seconds: ages are those of the nearer one, and errors half of those with the last one, which --causal takes
    by itself; a file says either, and flags overrule it.
    """
    header, end, body = (data / SET / "3034078M1.21O").read_text().partition("END OF HEADER")
    line, *epochs = re.split(r"(?m)^(?=> )", body)
    base, config, out = tmp_path / "base.obs", tmp_path / "solver.toml", tmp_path / "out.pos"
    base.write_text("".join([header, end, line, *(epoch for epoch in epochs if float(epoch[18:29]) % 15.0 == 0.0)]))
    config.write_text('[solver]\nrover = "rover"\nbase = "base"\nsync = { interpolate = false }\n')

    with_slow_base = [str(base) if word.endswith("3034078M1.21O") else word for word in arguments(data)]

    def solved(*more: str) -> tuple[float, list[float]]:
        """Return the error (m, median of the fixes) and the ages (s)."""
        assert run([*with_slow_base, f"--base-ecef={BASE_ECEF_M}", "--format", "xyz", "--out", str(out), "--quiet", *more]) == 0
        fixes = [[float(v) for v in row[2:5]] for row in rows(out) if row[5] == "1"]
        return float(np.median(np.linalg.norm(np.array(fixes) - TRUTH_ECEF_M, axis=1))), [float(row[13]) for row in rows(out)]

    error_m, ages_s = solved()
    old_error_m, old_ages_s = solved("--no-interpolation")
    assert error_m < 0.6 * old_error_m
    assert ages_s[:18] == pytest.approx([*range(8), *range(-7, 0), 0, 1, 2], abs=1e-3)
    assert old_ages_s == pytest.approx([k % 15 for k in range(60)], abs=1e-3)
    assert solved("--config", str(config)) == solved("--causal") == (old_error_m, old_ages_s)
    assert solved("--config", str(config), "--interpolation")[0] == error_m


@pytest.mark.data
def test_single_needs_no_base(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Mode single solves one recording; without --out the .pos text is standard output."""
    folder = data / SET
    code = run(["solve", "--mode", "single", "--rover", f"{folder}/SEPT078M1.21O", "--nav", f"{folder}/SEPT078M.21P", "--format", "xyz"])
    lines = [line.split() for line in capsys.readouterr().out.splitlines() if not line.startswith("%")]
    assert code == 0
    assert len(lines) == 60
    assert {line[5] for line in lines} == {"5"}
    errors_m = np.linalg.norm(np.array([[float(v) for v in line[2:5]] for line in lines]) - TRUTH_ECEF_M, axis=1)
    assert np.median(errors_m) < 10.0


@pytest.mark.data
def test_configuration_file_and_flags(data: Path, tmp_path: Path) -> None:
    """Options come from the file, flags overrule them; the header says which were used."""
    config, out = tmp_path / "solver.toml", tmp_path / "out.pos"
    config.write_text('[solver]\nrover = "rover"\nbase = "base"\nmode = "static"\nelevation_mask_deg = 20.0\nfrequencies = 1\n')
    assert run(arguments(data, "--config", str(config), "--frequencies", "2", "--out", str(out), "--quiet")) == 0
    notes = dict(line[2:].split(":", 1) for line in out.read_text().splitlines() if " : " in line[:14])
    assert {name.strip(): text.strip() for name, text in notes.items()}.items() >= {
        ("pos mode", "static"), ("elev mask", "20.0 deg"), ("freqs", "2"), ("navi sys", "GEJ"),
    }  # fmt: skip


@pytest.mark.data
def test_no_solution_is_exit_code_1(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Without navigation data nothing can be solved; the summary says why."""
    folder = data / SET
    code = run(["solve", "--rover", f"{folder}/SEPT078M1.21O", "--base", f"{folder}/3034078M1.21O", "--json"])
    summary = json.loads(capsys.readouterr().out)
    assert code == 1
    assert summary["solved"] == 0
    assert summary["reasons"] == {"no_ephemeris": 60}


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--rover", "absent.obs", "--base", "absent.obs"], "absent.obs does not exist"),
        (["--rover", "absent.obs"], "needs --base"),
        (["--rover", "r", "--base", "b", "--systems", "GX"], "the letters GRECJSI"),
        (["--rover", "r", "--base", "b", "--frequencies", "7"], "--frequencies 7: allowed are 1 to 5"),
        (["--rover", "r", "--base", "b", "--elmask", "95"], "0 to 90 degrees"),
        (["--rover", "r", "--base", "b", "--base-ecef=1,2"], "three numbers"),
        (["--rover", "r", "--base", "b", "--base-ecef=1,2,3"], "from the earth's centre"),
        (["--rover", "r", "--base", "b", "--base-llh=95,2,3"], "no latitude"),
        (["--rover", "r", "--base", "b", "--base-llh=5,2,3", "--base-ecef=1,2,3"], "both given"),
        (["--rover", "r", "--base", "b", "--date", "14.7.2018"], "no day YYYY-MM-DD"),
        (["--rover", "r", "--base", "b", "--config", "absent.toml"], "absent.toml: no such file"),
        (["--rover", "r", "--base", "b", "--base-ecef", "-1,2,x"], "--base-ecef=-1,2,x is not three numbers"),
        (["--rover", "r", "--mode", "single", "--format", "enu"], "mode 'single' has none"),
        (["--rover", "r", "--mode", "single", "--format", "vel_enu"], "mode 'single' has none"),
        (["--rover", "r", "--base", "b", "--format", "enu", "--velocity"], "--velocity: columns of llh and xyz"),
        (["--rover", "r", "--base", "b", "--ambiguity", "fix-and-holt"], "fix-and-hold"),
        (["--rover", "r", "--mode", "single", "--direction", "combined"], "mode 'single' has no memory"),
        (["--rover", "r", "--base", "b", "--direction", "sideways"], "backward"),
        (["--rover", "r", "--base", "b", "--mode", "fixed"], "fixed_position_ecef_m"),
        (["--rover", "r", "--base", "b", "--mode", "kinematik"], "kinematic"),
        (["--rovr", "r"], "--rover"),
        ([], "--rover"),
    ],
)
def test_wrong_usage_is_exit_code_2(flags: list[str], words: str, capfd: pytest.CaptureFixture[str]) -> None:
    """Every mistake is one line that names the flag, and exit code 2."""
    assert run(["solve", *flags]) == 2
    assert words in " ".join(capfd.readouterr().err.replace("│", " ").split())


def test_configuration_faults_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A wrong key is named with its line and the nearest right one."""
    config = tmp_path / "solver.toml"
    config.write_text('[solver]\nrover = "rover"\nbase = "base"\nelevation_mask = 20.0\n')
    assert run(["solve", "--rover", "r", "--base", "b", "--config", str(config)]) == 2
    message = capsys.readouterr().err
    assert "solver.toml:4" in message
    assert "elevation_mask_deg" in message


@pytest.mark.data
def test_options_that_contradict_each_other_are_told_with_their_file(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What only the engine sees: too few ambiguities for a baseline whose length nobody knows."""
    config = tmp_path / "few.toml"
    config.write_text('[solver]\nrover = "rover"\nbase = "base"\nambiguity.minimum_ambiguities = 4\n')
    assert run(arguments(data, "--config", str(config))) == 2
    assert f"{config}: minimum_ambiguities is 4" in capsys.readouterr().err


def test_unwritable_output(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """An output that cannot be opened is exit code 2."""
    assert run(arguments(data, "--out", "/absent/folder/out.pos")) == 2
    assert "/absent/folder/out.pos" in capsys.readouterr().err


@pytest.mark.data
def test_full_disk_is_said_without_traceback(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """An output that takes no more is the site's fault: one line, exit code 2."""
    assert run(arguments(data, "--out", "/dev/full")) == 2
    assert capsys.readouterr().err == "rtkmesh: /dev/full: No space left on device\n"


@pytest.mark.data
def test_recordings_in_the_wrong_place_are_named(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A navigation file as rover, RTCM 3 logs without any date: said before a line is solved."""
    nav, stromlo = data / SET / "SEPT078M.21P", data / "stromlo_rtcm"
    assert run(["solve", "--mode", "single", "--rover", str(nav)]) == 2
    assert f"{nav} has no observations: it holds rinex navigation" in capsys.readouterr().err
    logs = ["--rover", f"{stromlo}/week-rollover-STR24.rtcm3", "--base", f"{stromlo}/week-rollover-STR17.rtcm3"]
    assert run(["solve", *logs]) == 2
    assert "carries no date" in capsys.readouterr().err


def test_help_is_light() -> None:
    """Help imports neither numba nor numpy nor the engine: it answers in well under a second."""
    code = (
        "import sys\nfrom rtkmesh_services.cli.main import run\n"
        "assert run(['solve', '--help']) == 0 and run(['--help']) == 0\n"
        "assert not {'numba', 'numpy', 'zenoh', 'rtkmesh.gnss', 'rtkmesh.rtk'} & set(sys.modules), 'heavy'\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "--base-ecef" in done.stdout
    assert "Examples" in done.stdout


@pytest.mark.data
def test_rtcm_log_takes_its_date_from_the_other_recording(data: Path) -> None:
    """Beside a dated recording an RTCM 3 log needs no --date: its week is the other's."""
    from rtkmesh.gnss.epoch import Epoch
    from rtkmesh_services.cli.offline import open_inputs

    rtcm = data / "stromlo_rtcm/week-rollover-STR24.rtcm3"  # 2018
    inputs = open_inputs(rtcm, data / "yamatogawa_walk/yamatogawa_rover.obs", (), None)  # 2010-01-06
    first = next(message for message in inputs.rover.messages() if isinstance(message, Epoch))
    inputs.rover.close()
    assert first.time.week in {1564, 1565}


@pytest.mark.data
def test_sentences_of_no_use_are_left_out(data: Path) -> None:
    """Satellites in view are half of an M8's log, and no solution takes anything from them."""
    from rtkmesh_services.cli.offline import open_inputs

    rover = open_inputs(data / "galway_m8p" / "rover-20181004-1237.ubx.gz", None, (), None).rover
    assert sum(1 for _ in rover.messages()) > 1000
    assert rover.decoding.ignored["nmea/GPGSV"] > 1000
    assert not any("GSV" in name for name in rover.decoding.decoded)
    assert rover.decoding.decoded["nmea/GNRMC"] > 1000
