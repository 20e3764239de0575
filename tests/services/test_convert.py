"""``rtkmesh convert``: what goes in comes out in every format, files are replaced only with --force, and a run that fails leaves none."""

import csv
import json
import subprocess
import sys
from dataclasses import replace
from datetime import UTC, datetime
from itertools import islice
from math import isnan
from pathlib import Path

import numpy as np
import pytest

from rtkmesh.codecs import novatel_encode, sbf_encode, unicore_encode
from rtkmesh.codecs.messages import Message
from rtkmesh.codecs.nmea_encode import zda
from rtkmesh.codecs.stream import StreamDecoder
from rtkmesh.gnss.ephemeris import GlonassEphemeris, KeplerEphemeris, ReferenceStation
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.time import GpsTime
from rtkmesh.simulation.scenario import open_stream
from rtkmesh_services.cli.main import run
from rtkmesh_services.cli.recordings import open_recordings

START = GpsTime(2400, 345600.0)
DAY = "2026-01-08"
EPOCHS = 6


def simulated(antenna: str) -> bytes:
    stream = open_stream("static", antenna, seed=1, rate_hz=1.0, start=START)
    return b"".join(epoch.data for epoch in islice(stream.epochs(), EPOCHS))


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("logs")
    (folder / "rover.ubx").write_bytes(simulated("rover"))
    (folder / "base.rtcm3").write_bytes(simulated("base"))
    return folder


@pytest.fixture(autouse=True)
def there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def files() -> list[str]:
    return sorted(path.name for path in Path().iterdir())


def messages_of(*paths: Path, date: GpsTime | None = START) -> list[Message]:
    return [message for recording in open_recordings(list(paths), date) for message in recording.messages()]


def epochs_of(*paths: Path) -> list[Epoch]:
    return [message for message in messages_of(*paths) if isinstance(message, Epoch)]


def ephemerides_of(*paths: Path) -> set[tuple[int, GpsTime]]:
    return {(m.satellite, m.toe) for m in messages_of(*paths) if isinstance(m, KeplerEphemeris | GlonassEphemeris)}


@pytest.mark.parametrize("to", ["rinex", "rinex4"])
def test_a_log_becomes_two_rinex_files(logs: Path, there: Path, to: str):
    assert run(["convert", str(logs / "rover.ubx"), "--to", to, "--quiet"]) == 0
    assert files() == ["rover.nav", "rover.obs"]
    before, after = epochs_of(logs / "rover.ubx"), epochs_of(there / "rover.obs")
    assert len(before) == len(after) == EPOCHS
    for one, other in zip(before, after, strict=True):
        assert other.satellite.tolist() == one.satellite.tolist()
        assert other.flags.tolist() == one.flags.tolist()
        np.testing.assert_allclose(other.phase_cyc, one.phase_cyc, rtol=0.0, atol=5.1e-4)
    assert ephemerides_of(there / "rover.nav") == ephemerides_of(logs / "rover.ubx")


def test_rinex_becomes_a_stream_and_a_stream_rinex(logs: Path, there: Path):
    """UBX to RINEX to RTCM 3: the same satellites, signals and ephemerides; the date of an RTCM log must be said."""
    assert run(["convert", str(logs / "rover.ubx"), "--to", "rinex", "--quiet"]) == 0
    assert (
        run(["convert", "rover.obs", "rover.nav", "--to", "rtcm3", "--msm", "4", "--station-id", "12", "--out", "x.rtcm3", "--quiet"]) == 0
    )
    assert ephemerides_of(there / "x.rtcm3") == ephemerides_of(logs / "rover.ubx")
    for one, other in zip(epochs_of(logs / "rover.ubx"), epochs_of(there / "x.rtcm3"), strict=True):
        assert other.satellite.tolist() == one.satellite.tolist()
        assert abs(other.time - one.time) < 0.0006
    frames = [frame for frame, _ in StreamDecoder().feed((there / "x.rtcm3").read_bytes())]
    assert {frame.kind for frame in frames} >= {"1074", "1094", "1019", "1033"}
    assert {int.from_bytes(f.data[4:6], "big") & 0xFFF for f in frames if f.kind == "1074"} == {12}
    assert run(["convert", "x.rtcm3", "--to", "csv", "--quiet"]) == 2
    assert run(["convert", "x.rtcm3", "--to", "csv", "--date", DAY, "--quiet"]) == 0
    assert run(["convert", "x.rtcm3", "rover.obs", "--to", "csv", "--out", "y.csv", "--quiet"]) == 0


def test_a_base_station_keeps_what_it_says_of_itself(logs: Path, there: Path):
    assert run(["convert", str(logs / "base.rtcm3"), "--to", "rinex", "--date", DAY, "--marker", "ROOF", "--quiet"]) == 0
    told, before = (
        next(m for m in reversed(messages_of(path)) if isinstance(m, ReferenceStation))
        for path in (there / "base.obs", logs / "base.rtcm3")
    )
    assert before.position_ecef_m is not None
    assert told.position_ecef_m == pytest.approx(before.position_ecef_m, abs=1e-4)
    assert (told.antenna, told.receiver) == (before.antenna, before.receiver)
    assert b"ROOF" in (there / "base.obs").read_bytes()


def test_csv_has_a_line_for_every_observation(logs: Path, there: Path):
    assert run(["convert", str(logs / "rover.ubx"), "--to", "csv", "--quiet"]) == 0
    with (there / "rover.csv").open() as file:
        rows = list(csv.DictReader(file))
    expected = [(epoch.time.tow_s, *row) for epoch in epochs_of(logs / "rover.ubx") for row in epoch.rows()]
    assert len(rows) == len(expected)
    for row, (tow_s, satellite, code, *values) in zip(rows, expected, strict=True):
        assert (int(row["week"]), float(row["tow_s"]), row["satellite"], row["signal"]) == (START.week, tow_s, satellite, code)
        for name, value in zip(("pseudorange_m", "phase_cyc", "doppler_hz", "cn0_dbhz"), values, strict=True):
            assert row[name] == "" if isnan(value) else float(row[name]) == value


def test_json_has_a_line_for_every_message(logs: Path, there: Path, capsys: pytest.CaptureFixture[str]):
    """And --json tells what was done."""
    assert run(["convert", str(logs / "rover.ubx"), "--to", "json", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    lines = [json.loads(line) for line in (there / "rover.json").read_text().splitlines()]
    kinds = [line["message"] for line in lines]
    assert (told["epochs"], told["ephemerides"]) == (kinds.count("epoch"), kinds.count("ephemeris") + kinds.count("glonass_ephemeris"))
    assert told["observations"] == sum(len(line["observations"]) for line in lines if line["message"] == "epoch")
    assert told["files"] == [{"path": "rover.json", "bytes": (there / "rover.json").stat().st_size}]
    one = next(line for line in lines if line["message"] == "ephemeris")
    assert one["satellite"][0] in "GECJ"
    assert one["navigation"] in ("LNAV", "INAV", "D1")
    assert one["toe"][0] == START.week


def test_what_is_wanted_of_it(logs: Path, there: Path):
    """Systems, an interval and a span of time."""
    first = GpsTime(START.week, START.tow_s + 1.5).to_calendar().strftime("%Y-%m-%dT%H:%M:%S.%f")
    words = ["--systems", "GE", "--interval", "2", "--start", first, "--quiet"]
    assert run(["convert", str(logs / "rover.ubx"), "--to", "rinex", *words]) == 0
    epochs = epochs_of(there / "rover.obs")
    assert [round(epoch.time - START) for epoch in epochs] == [2, 4]
    assert {system for epoch in epochs for system in (epoch.satellite // 64).tolist()} == {0, 2}
    assert {satellite // 64 for satellite, _ in ephemerides_of(there / "rover.nav")} == {0, 2}


def test_no_file_is_replaced_without_force(logs: Path, there: Path, capsys: pytest.CaptureFixture[str]):
    words = ["convert", str(logs / "rover.ubx"), "--to", "rinex", "--quiet"]
    (there / "rover.nav").write_text("mine")
    assert run(words) == 2
    assert "rover.nav exists: say --force" in capsys.readouterr().err
    assert files() == ["rover.nav"]
    assert run([*words, "--force"]) == 0
    assert (there / "rover.nav").read_text() != "mine"
    assert run(["convert", "rover.obs", "--to", "rinex", "--force", "--quiet"]) == 2
    assert "is what is to be converted" in capsys.readouterr().err


def test_nothing_to_convert_is_one_and_leaves_no_file(there: Path, capsys: pytest.CaptureFixture[str]):
    (there / "talk.nmea").write_text(zda(datetime(2026, 1, 8, tzinfo=UTC)) * 3)
    for to in ("rinex", "csv", "rtcm3"):
        assert run(["convert", "talk.nmea", "--to", to]) == 1
    assert "nothing" in capsys.readouterr().err
    assert files() == ["talk.nmea"]


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--interval", "-1"], "allowed are 0 to 86400"),
        (["--systems", "GX"], "allowed are the letters"),
        (["--start", "yesterday"], "YYYY-MM-DDTHH:MM:SS"),
        (["--end", "2026-01-08T00:00:00Z"], "without a time zone"),
        (["--station-id", "5000"], "0 to 4095"),
        (["--date", "8.1.2026"], "no day YYYY-MM-DD"),
        (["--out", "no/such/folder/x"], "No such file"),
    ],
)
def test_wrong_words_are_said(logs: Path, capsys: pytest.CaptureFixture[str], words: list[str], text: str):
    assert run(["convert", str(logs / "rover.ubx"), "--to", "csv", *words]) == 2
    assert text in capsys.readouterr().err
    assert files() == []


def test_a_missing_recording_leaves_nothing(there: Path):
    assert run(["convert", "nothing.ubx", "--to", "csv"]) == 2
    assert files() == []


@pytest.mark.parametrize("to", ["csv", "rtcm3", "rinex"])
def test_a_disk_that_is_full_leaves_nothing(logs: Path, to: str):
    """A process of its own, whose files cannot grow beyond a kibibyte."""
    command = [sys.executable, "-m", "rtkmesh_services.cli.main", "convert", str(logs / "rover.ubx"), "--to", to, "--quiet"]
    done = subprocess.run(
        ["sh", "-c", 'ulimit -f 2; exec "$@"', "sh", *command], capture_output=True, text=True, timeout=120, check=False
    )  # the blocks of sh are of 512 bytes
    assert done.returncode == 2
    assert "File too large" in done.stderr
    assert files() == []


def log_of(maker: str) -> bytes:
    """Return a log of what the simulated rover sees, in another maker's protocol."""
    messages = [message for _, found in StreamDecoder().feed(simulated("rover")) for message in found]
    epochs = [message for message in messages if isinstance(message, Epoch)]
    orbits = [message for message in messages if isinstance(message, KeplerEphemeris | GlonassEphemeris)]
    observations, orbit = {
        "sbf": (sbf_encode.encode_meas_epoch, sbf_encode.encode_ephemeris),
        "unicore": (unicore_encode.encode_observations, unicore_encode.encode_ephemeris),
        "novatel": (novatel_encode.encode_observations, novatel_encode.encode_ephemeris),
    }[maker]
    whole_ms = [replace(epoch, time=GpsTime(epoch.time.week, round(epoch.time.tow_s, 3))) for epoch in epochs]
    logs = [observations(epoch) for epoch in whole_ms]
    return b"".join([logs[0], *(orbit(e, START) for e in orbits), *logs[1:]])


@pytest.mark.parametrize("maker", ["sbf", "unicore", "novatel"])
def test_logs_of_other_receivers_become_rinex(there: Path, maker: str):
    """The kind is found from the content; satellites, values and orbits are those of the log."""
    log = there / f"rover.{maker}"
    log.write_bytes(log_of(maker))
    (recording,) = open_recordings([log], None)
    assert recording.kind == maker
    recording.close()
    assert run(["convert", str(log), "--to", "rinex", "--quiet"]) == 0
    before, after = epochs_of(log), epochs_of(there / "rover.obs")
    assert len(before) == len(after) == EPOCHS
    for one, other in zip(before, after, strict=True):
        assert [row[:2] for row in other.rows()] == [row[:2] for row in one.rows()]
        np.testing.assert_allclose(other.pseudorange_m, one.pseudorange_m, rtol=0.0, atol=5.1e-4)
        np.testing.assert_allclose(other.phase_cyc, one.phase_cyc, rtol=0.0, atol=5.1e-4)
    assert ephemerides_of(there / "rover.nav") == ephemerides_of(log)


def test_receivers_options_are_taken(logs: Path, there: Path, capsys: pytest.CaptureFixture[str]):
    """-TADJ moves the epochs of a receiver to whole steps, as convbin's -ro does; what is no option is named."""
    epochs = [replace(epoch, time=epoch.time + 0.003) for epoch in epochs_of(logs / "rover.ubx")]
    (there / "late.nov").write_bytes(b"".join(novatel_encode.encode_observations(epoch) for epoch in epochs))
    for options, expected in (("", 0.003), ("-TADJ=0.1", 0.0)):
        assert run(["convert", "late.nov", "--to", "csv", "--receiver-options", options, "--force", "--quiet"]) == 0
        with (there / "late.csv").open() as file:
            assert {round(float(row["tow_s"]) % 1.0, 6) for row in csv.DictReader(file)} == {expected}
    assert run(["convert", str(logs / "rover.ubx"), "--to", "json", "--receiver-options", "-TADJJ=1", "--quiet"]) == 2
    assert "--receiver-options" in capsys.readouterr().err
