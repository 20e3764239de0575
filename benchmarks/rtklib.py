"""RTKLIB's own programs on a case: receiver logs to RINEX by convbin, RINEX to solutions by rnx2rtkp, with the options beside the data."""

import gzip
import os
import re
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from time import monotonic
from typing import IO, Final

import hatanaka

from cases import Case
from score_pos import Track, read_track

PROGRAMS: Final = ("rnx2rtkp", "convbin")
TIMEOUT_S: Final = 1200.0
# 2.4.3 b34 knows these names only and falls back to l1+2 for demo5's, which are in the stored options.
_FREQUENCIES: Final = {1: "l1", 2: "l1+2", 3: "l1+2+3"}
_DEMO5_FREQUENCIES: Final = {1: "l1", 2: "l1+l2", 3: "l1+l2+l5"}
_DIRECTIONS: Final[dict[str, list[str]]] = {"forward": [], "backward": ["-b"], "combined": ["-c"]}
_FORMATS: Final = {".ubx": "ubx", ".rtcm3": "rtcm3"}
_SYSTEM_BITS: Final = {"G": 1, "R": 4, "E": 8, "J": 16, "C": 32}
# As in the options that lie beside the recordings.
_PLAIN: Final = """
pos1-soltype=forward
pos1-elmask=15
pos1-dynamics=off
pos1-ionoopt=brdc
pos1-tropopt=saas
pos1-sateph=brdc
pos2-bdsarmode=on
pos2-arthres=3
pos2-arelmask=15
pos2-arminfix=10
pos2-aroutcnt=20
pos2-maxage=30
pos2-slipthres=0.05
pos2-rejionno=30
pos2-rejgdop=30
out-outhead=on
out-timesys=gpst
stats-eratio1=300
stats-eratio2=300
stats-errphase=0.003
stats-errphaseel=0.003
stats-stdbias=30
"""


class ProgramError(Exception):
    """A program that did not do its work."""


@dataclass(frozen=True, slots=True)
class Finished:
    """A program that has ended: what it printed and what it cost."""

    output: str
    cpu_s: float
    wall_s: float


def run(argv: list[str]) -> Finished:
    """Run a program to its end; ProgramError with its last words unless it ends with 0.

    Python's programs may keep what they compile, as where they are installed: PYTHONDONTWRITEBYTECODE would cost half a second each.
    """
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        started = monotonic()
        process = subprocess.Popen(argv, stdin=subprocess.DEVNULL, stdout=out, stderr=err, env=environment)
        watch = threading.Timer(TIMEOUT_S, process.kill)
        watch.start()
        _, status, usage = os.wait4(process.pid, 0)
        watch.cancel()
        process.returncode = code = os.waitstatus_to_exitcode(status)
        wall_s = monotonic() - started
        said, complaint = _text(out), _text(err)
    if code:
        raise ProgramError(f"{Path(argv[0]).name} ended with {code}: {(complaint or said).strip()[-200:]}")
    return Finished(said, usage.ru_utime + usage.ru_stime, wall_s)


def _text(file: IO[bytes]) -> str:
    file.seek(0)
    return file.read().decode(errors="replace")


def missing() -> list[str]:
    """Return which of RTKLIB's programs are not installed."""
    return [name for name in PROGRAMS if shutil.which(name) is None]


def solve(case: Case, folder: Path, out: Path, direction: str = "forward", further: str = "") -> Finished:
    """Solve a case with rnx2rtkp, with ``further`` lines of options; the cost is that of rnx2rtkp alone, without the conversion to RINEX.

    Backward, rnx2rtkp writes from the last epoch to the first; the file is put in order of time.
    """
    done = run(command(case, rinex(case, folder), folder, out, *_DIRECTIONS[direction], further=further))
    if direction == "backward":
        lines = out.read_text().splitlines(keepends=True)
        out.write_text("".join([line for line in lines if line[0] == "%"] + sorted(line for line in lines if line[0] != "%")))
    return done


def command(case: Case, files: list[Path], folder: Path, out: Path, *flags: str, further: str = "") -> list[str]:
    """Return the command that solves a case's RINEX files."""
    conf = folder / "rnx2rtkp.conf"
    conf.write_text(f"{options(case)}\n{further}")
    return ["rnx2rtkp", "-k", str(conf), *flags, "-o", str(out), *map(str, files)]


def stored_options(case: Case) -> Path:
    """Return the file of the options that the stored solution was made with; frequencies have demo5's names."""
    stored = case.stored["b34"]
    return stored.with_name(stored.name.removesuffix(".b34.pos") + ".conf")


def options(case: Case) -> str:
    """Return the stored options, the frequencies under the name that b34 knows."""
    conf = stored_options(case)
    text, count = re.subn(r"(?m)^(pos1-frequency\s*=).*$", rf"\g<1>{_FREQUENCIES[case.frequencies]}", conf.read_text())
    if count != 1:
        raise ProgramError(f"{conf.name}: these options do not name the frequencies")
    return text


def rinex(case: Case, folder: Path) -> list[Path]:
    """Return a case as RINEX: rover, base, then navigation files."""
    rover, rover_navigation = _rinex(case.rover, case.date, folder)
    base, base_navigation = _rinex(case.base, case.date, folder)
    return [rover, base, *case.navigation, *base_navigation, *rover_navigation]


def plain_options(mode: str, systems: str, frequencies: int, ambiguities: str, *, demo5: bool = False) -> str:
    """Return plain options of b34 or demo5 for a mode (kinematic, movingbase), RINEX letters, bands and a way with ambiguities.

    GLONASS stays float, as in the options beside the recordings of receivers of two makes.
    """
    bands = (_DEMO5_FREQUENCIES if demo5 else _FREQUENCIES)[frequencies]
    bits = sum(_SYSTEM_BITS[system] for system in systems)
    chosen = {"pos1-posmode": mode, "pos1-navsys": bits, "pos1-frequency": bands, "pos2-armode": ambiguities}
    return _PLAIN + "pos2-gloarmode=off\n" + "".join(f"{name}={value}\n" for name, value in chosen.items())


def base_options(base_ecef_m: Iterable[float]) -> str:
    """Return the options of a base that stands there, and of positions as ECEF."""
    x, y, z = base_ecef_m
    return f"out-solformat=xyz\nant2-postype=xyz\nant2-pos1={x:.4f}\nant2-pos2={y:.4f}\nant2-pos3={z:.4f}\n"


def moving_base(case: Case, systems: str, frequencies: int, ambiguities: str, length_m: float | None = None) -> Track:
    """Return the baselines (east-north-up) of rnx2rtkp on a recorded pair as a moving base, whose length it is told or not."""
    known = "" if length_m is None else f"pos2-baselen={length_m}\npos2-basesig=0.005\n"
    with tempfile.TemporaryDirectory() as folder:
        conf, out = Path(folder) / "moving.conf", Path(folder) / "moving.pos"
        conf.write_text(plain_options("movingbase", systems, frequencies, ambiguities) + "out-solformat=enu\n" + known)
        run(["rnx2rtkp", "-k", str(conf), "-o", str(out), *map(str, rinex(case, Path(folder)))])
        return read_track(out)


def converted(log: Path, folder: Path) -> tuple[Path, list[Path]]:
    """Return a receiver's log as RINEX observations, and the navigation files that came out of it."""
    return _converted(log, _FORMATS[log.suffix], "", folder)


def _rinex(recording: Path, date: str, folder: Path) -> tuple[Path, list[Path]]:
    """Return a recording as RINEX observations, and the navigation files that came out of it."""
    file = plain(recording, folder)
    return _converted(file, _FORMATS[file.suffix], date, folder) if file.suffix in _FORMATS else (file, [])


def plain(recording: Path, folder: Path) -> Path:
    """Return a recording without its compression, gzip's or Hatanaka's."""
    if recording.suffix == ".gz":
        file = folder / recording.stem
        file.write_bytes(gzip.decompress(recording.read_bytes()))
        return file
    if re.fullmatch(r"\.\d\dd", recording.suffix):
        file = folder / (recording.stem + recording.suffix[:-1] + "o")
        file.write_bytes(hatanaka.decompress(recording.read_bytes()))
        return file
    return recording


def _converted(log: Path, form: str, date: str, folder: Path) -> tuple[Path, list[Path]]:
    observations, navigation = folder / (log.stem + ".obs"), folder / (log.stem + ".nav")
    argv = ["convbin", "-r", form, "-v", "3.04", "-od", "-os", "-o", str(observations), "-n", str(navigation)]
    if date:
        argv += ["-tr", date.replace("-", "/"), "12:00:00"]
    run([*argv, str(log)])
    if date:
        repair_weeks(observations, datetime.fromisoformat(date) + timedelta(hours=12))
    return observations, [navigation] if navigation.is_file() else []


def repair_weeks(observations: Path, about: datetime) -> None:
    """Put epochs that are whole weeks off back, and drop those of no sensible time.

    b34's convbin loses the week of MSM logs over a week rollover. The repair is in RTKLIB's favour: without it half of its epochs of such
    a log find no partner.
    """
    kept: list[str] = []
    sensible = True
    for line in observations.read_text().splitlines(keepends=True):
        if not line.startswith(">"):
            kept += [line] if sensible else []
            continue
        time = _epoch_time(line)
        time -= timedelta(weeks=round((time - about) / timedelta(weeks=1)))
        sensible = abs(time - about) <= timedelta(days=1)
        kept += [f"> {time:%Y %m %d}{line[12:]}"] if sensible else []
    observations.write_text("".join(kept))


def _epoch_time(line: str) -> datetime:
    """Return the minute of a RINEX 3 epoch line."""
    return datetime.strptime(line[2:18], "%Y %m %d %H %M")
