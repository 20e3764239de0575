"""A simulated run as receivers' bytes and as RINEX, and RTKLIB's programs on it.

b34 is a process of rnx2rtkp, demo5 its ``postpos`` in this process (PyPI pyrtklib5).
"""

import os
import sys
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from math import inf
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

import rtklib
from rtkmesh.codecs.rinex_navigation_write import navigation_header, navigation_record
from rtkmesh.codecs.rinex_write import Origin
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.time import GpsTime, gps_minus_utc_s
from rtkmesh.simulation.faults import with_orbit_error
from rtkmesh.simulation.receiver import Observed
from rtkmesh.simulation.rtcm3_stream import Rtcm3Stream
from rtkmesh.simulation.sky import KLOBUCHAR, SATELLITES, broadcast
from rtkmesh.simulation.ubx_stream import UbxStream
from score_pos import ScoreError, Track, read_track
from simulated import Simulated

Span = tuple[float, float]  # seconds of a run: its first epoch and the one after its last

ORIGIN: Final = Origin(3.05, "rtkmesh benchmarks", datetime(2026, 1, 1))
_KEPT_SIGMA_CYC: Final = 0.016
_BASE_SEED: Final = 1  # apart from the rover's: of what the receiver itself believes of its place


@dataclass(frozen=True, slots=True, eq=False)
class Sent:
    """What a rover sends and what it hears of its base, epoch by epoch: UBX and RTCM 3 (of a base that moves UBX as well)."""

    rover: list[bytes]
    base: list[bytes]  # nothing where the base is dead or its epoch never arrives
    base_form: str


def sent(run: Simulated, *, every_phase: bool = False) -> Sent:
    """Return the bytes of a run, with its faults.

    convbin drops a phase of which a u-blox receiver says that its sigma is 0.02 cycles or more, in a street a third of them; with
    ``every_phase`` receivers say less of all.
    """
    rover = UbxStream(run.seed, warm=True)
    x, y, z = run.base_ecef_m.tolist()
    base = UbxStream(run.seed + _BASE_SEED, warm=True) if run.setup.base_moves else Rtcm3Stream((x, y, z), warm=True)
    largest_cyc = _KEPT_SIGMA_CYC if every_phase else inf
    return Sent(
        [rover.encode(_told(o, epoch, largest_cyc)) for o, epoch in zip(run.rover, run.rover_epochs, strict=True)],
        [
            b"" if o is None or epoch is None else base.encode(_told(o, epoch, largest_cyc))
            for o, epoch in zip(_heard(run), run.base_epochs, strict=True)
        ],
        "ubx" if run.setup.base_moves else "rtcm3",
    )  # fmt: skip


def _heard(run: Simulated) -> list[Observed | None]:
    """Return the epochs of the base that arrive at some time."""
    setup = run.setup
    arriving = {told for second in range(setup.seconds) for told in setup.arrivals(second)}
    return [o if k // setup.base_hz in arriving else None for k, o in enumerate(run.base)]


def _told(observed: Observed, epoch: Epoch, largest_cyc: float) -> Observed:
    """Return what a receiver observed as an epoch with its faults, phases' sigmas not above a largest."""
    return replace(observed, epoch=replace(epoch, phase_sigma_cyc=np.minimum(epoch.phase_sigma_cyc, largest_cyc)))


@dataclass(frozen=True, slots=True)
class Files:
    """A run as RINEX."""

    folder: Path
    rover: Path
    base: Path
    navigation: tuple[Path, ...]

    @property
    def all(self) -> list[str]:
        """The files in the order in which rnx2rtkp wants them."""
        return [str(file) for file in (self.rover, self.base, *self.navigation)]


def converted(run: Simulated, data: Sent, folder: Path) -> Files:
    """Write the bytes as logs and have convbin make RINEX of them, with the ephemerides that the receivers handed out."""
    at = f"{run.start.to_calendar():%Y/%m/%d %H:%M:%S}".split()
    for name, form, parts in (("rover", "ubx", data.rover), ("base", data.base_form, data.base)):
        log = folder / f"{name}.{form}"
        log.write_bytes(b"".join(parts))
        argv = ["convbin", "-r", form, "-v", "3.04", "-od", "-os", "-tr", *at]
        rtklib.run([*argv, "-o", str(folder / f"{name}.obs"), "-n", str(folder / f"{name}.nav"), str(log)])
    return Files(folder, folder / "rover.obs", folder / "base.obs", (folder / "base.nav", folder / "rover.nav"))


def with_wrong_orbits(run: Simulated, files: Files) -> Files:
    """Return the files with the ephemerides that ``simulated.solve`` gives to a session, as wrong as broadcast ones are."""
    parts = [navigation_header(ORIGIN, [KLOBUCHAR], gps_minus_utc_s(run.start))]
    for satellite in SATELLITES.tolist():
        issues = {broadcast(satellite, time) for time in (run.start, run.start + float(run.setup.seconds))}
        parts += [navigation_record(with_orbit_error(issue, run.seed), ORIGIN.version) for issue in issues]
    path = files.folder / "all.nav"
    path.write_text("".join(parts))
    return replace(files, navigation=(path,))


def by_rnx2rtkp(start: GpsTime, files: Files, options: str, span: Span) -> Track | None:
    """Return what b34's rnx2rtkp makes of a span of a run that begins then, started with it; None where it solved nothing."""
    conf, out = files.folder / "b34.conf", files.folder / "b34.pos"
    conf.write_text(options)
    out.unlink(missing_ok=True)
    times: list[str] = []
    for flag, k in zip(("-ts", "-te"), span, strict=True):
        times += [flag, *f"{start.to_calendar() + timedelta(seconds=k - 0.5):%Y/%m/%d %H:%M:%S.%f}".split()]
    rtklib.run(["rnx2rtkp", "-k", str(conf), *times, "-o", str(out), *files.all])
    return _track(out)


def by_demo5(start: GpsTime, files: Files, options: str, span: Span) -> Track | None:
    """Return the same of demo5's postpos (PyPI pyrtklib5), in this process; ProgramError where it does not take its options."""
    conf, out = files.folder / "demo5.conf", files.folder / "demo5.pos"
    conf.write_text(options)
    out.unlink(missing_ok=True)
    words = files.folder / "demo5.err"
    with _stderr_into(words):
        _postpos(conf, start, span, files.all, out)
    if "invalid" in words.read_text(errors="replace"):
        raise rtklib.ProgramError(f"demo5 does not take its options: {words.read_text(errors='replace')[:200]}")
    return _track(out)


def _postpos(conf: Path, start: GpsTime, span: Span, inputs: list[str], out: Path) -> None:
    import pyrtklib5

    processing, solution, other = pyrtklib5.prcopt_t(), pyrtklib5.solopt_t(), pyrtklib5.filopt_t()
    pyrtklib5.resetsysopts()
    if not pyrtklib5.loadopts(str(conf), pyrtklib5.sysopts[0]):
        raise rtklib.ProgramError("demo5 does not read the options")
    pyrtklib5.getsysopts(processing, solution, other)
    begin, end = (pyrtklib5.gpst2time(start.week, start.tow_s + k - 0.5) for k in span)
    pyrtklib5.postpos(begin, end, 0.0, 0.0, processing, solution, other, inputs, len(inputs), str(out), "", "")


@contextmanager
def _stderr_into(path: Path) -> Generator[None]:
    """Have what C code says (of searches that it gives up) in a file."""
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with path.open("wb") as file:
            os.dup2(file.fileno(), 2)
            yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def _track(out: Path) -> Track | None:
    try:
        return read_track(out)
    except (OSError, ScoreError):  # not one solution in this span
        return None


def epochs_of(start: GpsTime, rate_hz: float, track: Track) -> NDArray[np.int64]:
    """Return the number of the epoch of a run that begins then that each solution belongs to; it may lie outside of the run."""
    begin_s = start.week * 604800.0 + start.tow_s
    return np.rint((track.time_s - begin_s) * rate_hz).astype(np.int64)
