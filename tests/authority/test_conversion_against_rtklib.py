"""What ``rtkmesh convert`` writes against RTKLIB: convbin's content on real recordings, rnx2rtkp's solutions, convbin reads our RTCM 3.

Differences that are explained in docs/how-to/convert.md are named here by their kind; any other one fails.
"""

import importlib.util
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from rtkmesh.codecs.rinex_observation import ObservationReader
from rtkmesh.gnss.constants import SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.signals import carrier_hz
from rtkmesh_services.cli.main import run as rtkmesh
from rtkmesh_services.ingest.recording import open_recording

pytestmark = [pytest.mark.data, pytest.mark.rtklib]
CONVERSION = Path(__file__).resolve().parents[2] / "benchmarks" / "conversion.py"
Find = Callable[[str], str]


@pytest.fixture(scope="module")
def conversion() -> Iterator[ModuleType]:
    """The comparison of the benchmarks, whose folder is no package."""
    spec = importlib.util.spec_from_file_location("conversion", CONVERSION)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules["conversion"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    yield module
    del sys.modules["conversion"]


def both(find: Find, source: Path, kind: str, folder: Path, day: str = "", hour: str = "12:00:00") -> tuple[Path, Path]:
    """Convert by both programs; return the names before .obs and .nav."""
    ours, theirs = folder / "ours", folder / "theirs"
    assert rtkmesh(["convert", str(source), "--to", "rinex", "--out", str(ours), "--quiet", *(["--date", day] if day else [])]) == 0
    date = ["-tr", day.replace("-", "/"), hour] if day else []
    outputs = ["-o", str(theirs.with_suffix(".obs")), "-n", str(theirs.with_suffix(".nav"))]
    command = [find("convbin"), "-r", kind, "-v", "3.04", "-od", "-os", *date, *outputs, str(source)]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    return ours, theirs


# kinds of differences that may be there, by their beginnings
WEAK_PHASES = "only ours: phase_cyc"  # convbin drops phases that the receiver gives a sigma above 0.02 cycles
UNKNOWN_TO_B34 = ("only ours: C 1P", "only ours: C 5P", "only ours: C 6I", "only ours: E 5Q", "only ours: E 6B", "only ours: G 5Q")
FLAGS = ("flag slip only",)  # the first epoch of an arc, and arcs shorter than the gap before them
RECORDINGS = [
    ("dec_ubx/gnss_imu_walk_1730.ubx", "ubx", "", "", 46_000, (WEAK_PHASES, *UNKNOWN_TO_B34)),
    ("umea_f9p/B001.ubx", "ubx", "", "", 61_000, (WEAK_PHASES,)),
    ("dec_rtcm3/piksi-5Hz.rtcm3", "rtcm3", "2018-07-17", "08:00:00", 1_000, ()),
    ("stromlo_rtcm/missing-beidou-STR17.rtcm3", "rtcm3", "2018-07-14", "23:00:00", 200_000, ()),
]


@pytest.mark.parametrize(("name", "kind", "day", "hour", "least", "explained"), RECORDINGS)
def test_every_observation_is_convbins(
    data: Path, rtklib_program: Find, conversion: ModuleType, tmp_path: Path,
    name: str, kind: str, day: str, hour: str, least: int, explained: tuple[str, ...],
) -> None:  # fmt: skip
    """Each value of each file is in the other one to the last digit, half cycles are the same, but for what is explained."""
    ours, theirs = both(rtklib_program, data / name, kind, tmp_path, day, hour)
    seen = conversion.compare_observations(ours.with_suffix(".obs"), theirs.with_suffix(".obs"))
    assert sum(count for what, count in seen.counts.items() if what.endswith(" alike")) >= least
    unexplained = {what: count for what, count in seen.counts.items() if "only" in what or what.startswith("value")}
    assert not {what for what in unexplained if not what.startswith((*explained, *FLAGS))}, seen.examples
    records = conversion.compare_navigation(ours.with_suffix(".nav"), theirs.with_suffix(".nav"))
    fields = {
        "R accuracy_m",
        "R group_delay_s",
        "G transmitted",
        "E transmitted",
        "J transmitted",
        "C transmitted",
        "R transmitted",
        "G fit_s",
    }
    assert not {what for what in records.counts if "only theirs" in what}
    assert not {what for what in records.counts if what.startswith("value") and what.removeprefix("value ") not in fields}, records.examples


def positions(find: Find, out: Path, rover: Path, base: Path) -> list[tuple[str, ...]]:
    """Return time, position, quality and satellites of rnx2rtkp's solutions."""
    options = ["-p", "2", "-m", "15", "-f", "2", "-ts", "2018/07/14", "23:50:20", "-te", "2018/07/14", "23:55:00", "-t", "-e"]
    where = ["-r", "-4467102.3061", "2683039.5304", "-3666949.9820"]
    command = [find("rnx2rtkp"), *options, *where, "-o", str(out), str(rover), str(base), str(base.with_suffix(".nav"))]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    return [tuple(line.split()[:7]) for line in out.read_text().splitlines() if line and line[0] != "%"]


def test_rnx2rtkp_solves_our_files_as_convbins(data: Path, rtklib_program: Find, tmp_path: Path) -> None:
    """The same epochs, qualities and positions to the last printed digit."""
    names, folders = ("STR24", "STR17"), [tmp_path / name for name in ("rover", "base")]
    files: list[tuple[Path, Path]] = []
    for name, folder in zip(names, folders, strict=True):
        folder.mkdir()
        files.append(both(rtklib_program, data / "stromlo_rtcm" / f"week-rollover-{name}.rtcm3", "rtcm3", folder, "2018-07-14", "23:00:00"))
    ours, theirs = (
        positions(rtklib_program, tmp_path / f"{k}.pos", files[0][k].with_suffix(".obs"), files[1][k].with_suffix(".obs")) for k in (0, 1)
    )
    assert len(ours) > 200
    assert {row[5] for row in ours} >= {"1"}
    assert ours == theirs


def test_rnx2rtkp_solves_with_a_thinned_base(data: Path, rtklib_program: Find, tmp_path: Path) -> None:
    """The base's MSM7 made into MSM4 with everything of a station around it: the same fixes, within the millimetre that MSM4 keeps."""
    log = data / "stromlo_rtcm" / "week-rollover-STR17.rtcm3"
    words = ["--to", "rtcm3", "--msm", "4", "--date", "2018-07-14", "--end", "2018-07-14T23:56:00", "--out", str(tmp_path / "thin.rtcm3")]
    assert rtkmesh(["convert", str(log), *words, "--quiet"]) == 0
    assert (tmp_path / "thin.rtcm3").stat().st_size < 0.6 * log.stat().st_size * 345.0 / 1126.0
    rover, _ = both(rtklib_program, log.with_name("week-rollover-STR24.rtcm3"), "rtcm3", tmp_path, "2018-07-14", "23:00:00")
    found: list[dict[str, list[float]]] = []
    for name, source in (("whole", log), ("thin", tmp_path / "thin.rtcm3")):
        base = tmp_path / f"{name}.obs"
        outputs = ["-o", str(base), "-n", str(base.with_suffix(".nav"))]
        command = [
            rtklib_program("convbin"),
            "-r",
            "rtcm3",
            "-v",
            "3.04",
            "-od",
            "-os",
            "-tr",
            "2018/07/14",
            "23:00:00",
            *outputs,
            str(source),
        ]
        subprocess.run(command, check=True, capture_output=True, timeout=120)
        rows = positions(rtklib_program, tmp_path / f"{name}.pos", rover.with_suffix(".obs"), base)
        found.append({row[1]: [float(value) for value in row[2:5]] for row in rows if row[5] == "1"})
    assert len(found[0].keys() & found[1].keys()) >= 0.98 * len(found[0])
    assert max(np.abs(np.subtract(found[0][time], found[1][time])).max() for time in found[0].keys() & found[1].keys()) < 2e-3


def test_convbin_reads_the_stream_of_a_raw_u_blox(data: Path, rtklib_program: Find, tmp_path: Path) -> None:
    """RAWX to MSM7 to RINEX: ranges are those of the receiver but for one clock term per epoch, phases but for that and whole cycles."""
    source, stream = data / "umea_f9p" / "B001.ubx", tmp_path / "base.rtcm3"
    assert rtkmesh(["convert", str(source), "--to", "rtcm3", "--out", str(stream), "--quiet"]) == 0
    outputs = ["-o", str(tmp_path / "read.obs"), "-n", str(tmp_path / "read.nav")]
    command = [rtklib_program("convbin"), "-r", "rtcm3", "-v", "3.04", "-od", "-os", "-tr", "2021/12/09", "12:00:00", *outputs, str(stream)]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    read = {round(epoch.time.tow_s, 3): epoch for epoch in ObservationReader((tmp_path / "read.obs").read_bytes())}
    epochs = [message for message in open_recording(source).messages() if isinstance(message, Epoch)]
    compared = 0
    for epoch in epochs[10:]:
        range_m, phase_m, off_cyc = apart(epoch, read[round(epoch.time.tow_s, 3)])
        assert np.ptp(range_m) < 2e-3
        np.testing.assert_allclose(off_cyc, 0.0, atol=0.02)
        compared += len(phase_m)
    assert compared > 10_000


def apart(a: Epoch, b: Epoch) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return how far ranges (m) and phases (m) are apart, and what is left of the phases without the ranges' part and whole cycles."""
    _, i, j = np.intersect1d(a.satellite.astype(int) * 512 + a.signal, b.satellite.astype(int) * 512 + b.signal, return_indices=True)
    range_m = b.pseudorange_m[j] - a.pseudorange_m[i]
    both = np.isfinite(a.phase_cyc[i]) & np.isfinite(b.phase_cyc[j]) & np.isfinite(range_m)
    i, j = i[both], j[both]
    carrier = np.array([carrier_hz(*one) for one in zip(a.satellite[i].tolist(), a.signal[i].tolist(), a.channel[i].tolist(), strict=True)])
    cycles = b.phase_cyc[j] - a.phase_cyc[i]
    rest = cycles - np.nanmedian(range_m) * carrier / SPEED_OF_LIGHT_MPS
    return range_m[np.isfinite(range_m)], cycles * SPEED_OF_LIGHT_MPS / carrier, rest - np.rint(rest)
