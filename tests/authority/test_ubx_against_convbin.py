"""Held against RTKLIB's convbin: observations and ephemerides of UBX recordings, value by value.

Differences that are explained, and checked to be nothing else: convbin drops phases whose standard deviation index is above 5; it
marks a slip at a signal's first phase and after phases it dropped; it loses good frames behind damaged ones; its ephemerides carry
the time of the last repetition; RINEX 3.04 has neither accuracy nor group delay of GLONASS; it knows no I/NAV page of 8 words.
"""

import gzip
import subprocess
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtkmesh.codecs.rinex_navigation import read_navigation
from rtkmesh.codecs.stream import StreamDecoder, StreamOptions
from rtkmesh.gnss.ephemeris import GlonassEphemeris, KeplerEphemeris
from rtkmesh.gnss.epoch import HALF_CYCLE, SLIP, Epoch
from rtkmesh.gnss.signals import satellite_id, signal_code
from rtkmesh.gnss.time import GpsTime

pytestmark = [pytest.mark.data, pytest.mark.rtklib]

Record = tuple[GpsTime, dict[tuple[str, str], tuple[float, str]]]  # (satellite, observation) -> value, loss of lock indicator

_ROUNDING = 6e-4  # three decimals
_MAX_PHASE_SIGMA_CYC = 0.0201  # index 5


def converted(log: Path, folder: Path, convbin: str) -> tuple[list[Record], str]:
    """Return convbin's observations and navigation file of a UBX log."""
    plain = folder / "log.ubx"
    plain.write_bytes(gzip.decompress(log.read_bytes()) if log.suffix == ".gz" else log.read_bytes())
    command = [convbin, "-r", "ubx", "-v", "3.04", "-od", "-os", "-o", "log.obs", "-n", "log.nav", plain.name]
    subprocess.run(command, cwd=folder, check=True, capture_output=True, timeout=120)
    navigation = folder / "log.nav"
    return records_of((folder / "log.obs").read_text()), navigation.read_text() if navigation.exists() else ""


def records_of(text: str) -> list[Record]:
    """Read RINEX 3 observations (independent of our own reader)."""
    header, body = text.split("END OF HEADER")
    types: dict[str, list[str]] = {}
    system = ""
    for line in header.splitlines():
        if line[60:].startswith("SYS / # / OBS TYPES"):
            system = line[0] if line[0] != " " else system
            types.setdefault(system, []).extend(line[7:60].split())
    records: list[Record] = []
    for line in body.splitlines()[1:]:
        if line.startswith(">"):
            f = line.split()
            records.append((GpsTime.from_calendar(*map(int, f[1:6]), float(f[6])), {}))
            continue
        for i, kind in enumerate(types[line[0]]):
            value = line[3 + 16 * i : 17 + 16 * i].strip()
            if value:
                records[-1][1][line[:3], kind] = float(value), line[17 + 16 * i : 18 + 16 * i].strip() or "0"
    return records


def decoded(log: Path) -> tuple[dict[int, Epoch], list[Any]]:
    data = gzip.decompress(log.read_bytes()) if log.suffix == ".gz" else log.read_bytes()
    decoder = StreamDecoder(StreamOptions(observations="ubx"))
    messages = [message for _, found in decoder.feed(data) for message in found] + decoder.flush()
    epochs = {milliseconds(m.time): m for m in messages if isinstance(m, Epoch)}
    return epochs, [m for m in messages if isinstance(m, KeplerEphemeris | GlonassEphemeris)]


def milliseconds(time: GpsTime) -> int:
    return round((time.week * 604_800 + time.tow_s) * 1000)


def compare_epoch(epoch: Epoch, observed: dict[tuple[str, str], tuple[float, str]], seen: set[tuple[str, str]]) -> int:
    """Compare one epoch; return the number of equal values. ``seen``: the phases of convbin's epoch before."""
    columns = {"C": epoch.pseudorange_m, "L": epoch.phase_cyc, "D": epoch.doppler_hz, "S": epoch.cn0_dbhz}
    compared = 0
    for k in range(len(epoch)):
        satellite, code = satellite_id(int(epoch.satellite[k])), signal_code(int(epoch.signal[k]))
        for kind, column in columns.items():
            theirs = observed.pop((satellite, kind + code), None)
            if kind == "L" and not epoch.phase_sigma_cyc[k] < _MAX_PHASE_SIGMA_CYC:
                assert theirs is None, (satellite, code)
            elif theirs is None:
                assert np.isnan(column[k]), (satellite, kind + code)
            else:
                assert column[k] == pytest.approx(theirs[0], abs=_ROUNDING), (satellite, kind + code)
                compared += 1
            if kind == "L" and theirs is not None:
                indicator = int(theirs[1])
                assert bool(indicator & 2) is bool(epoch.flags[k] & HALF_CYCLE)
                if (satellite, code) in seen:
                    assert bool(epoch.flags[k] & SLIP) >= bool(indicator & 1)
    assert not observed  # nothing of theirs is missing here
    return compared


@pytest.mark.parametrize(
    ("name", "values", "only_ours"),
    [
        ("umea_f9p/R001.ubx", 80_000, 0),
        ("umea_f9p/B001.ubx", 60_000, 0),
        ("galway_m8p/rover-20181004-1237.ubx.gz", 100_000, 3),
        ("galway_m8p/base-20181004-1236.ubx.gz", 23_000, 38),
    ],
)
def test_observations_are_those_of_convbin(
    data: Path, tmp_path: Path, rtklib_program: Callable[[str], str], name: str, values: int, only_ours: int
):
    """Every epoch of convbin's is ours, every value equal to the printed digits, every slip and half-cycle flag there."""
    records, _ = converted(data / name, tmp_path, rtklib_program("convbin"))
    epochs, _ = decoded(data / name)
    compared, seen = 0, set[tuple[str, str]]()
    for time, observed in records:
        phases = {(satellite, kind[1:]) for satellite, kind in observed if kind[0] == "L"}
        compared += compare_epoch(epochs.pop(milliseconds(time)), observed, seen)
        seen = phases
    assert compared > values
    assert len(epochs) == only_ours


def numbers(value: Any) -> list[float]:
    if isinstance(value, GpsTime):
        return [value.week * 604_800 + value.tow_s]
    return list(value) if isinstance(value, tuple) else [float(value)]


NOT_IN_RINEX = {KeplerEphemeris: {"transmitted"}, GlonassEphemeris: {"transmitted", "accuracy_m", "group_delay_s"}}


@pytest.mark.parametrize(
    ("name", "ephemerides", "unknown_to_convbin"),
    [
        ("umea_f9p/B001.ubx", 27, ""),
        ("galway_m8p/rover-20181004-1237.ubx.gz", 22, ""),
        ("galway_m8p/base-20181015-1654.ubx.gz", 36, ""),
        ("galway_m8p/rover-20190416-1617.ubx.gz", 39, ""),
        ("dec_ubx/gnss_imu_walk_1730.ubx", 12, "E"),
    ],
)
def test_ephemerides_are_those_of_convbin(
    data: Path, tmp_path: Path, rtklib_program: Callable[[str], str], name: str, ephemerides: int, unknown_to_convbin: str
):
    """Every ephemeris of convbin's (GPS, QZSS, Galileo, BeiDou, GLONASS) is ours, every value equal to 12 digits."""
    _, navigation = converted(data / name, tmp_path, rtklib_program("convbin"))
    _, ours = decoded(data / name)
    theirs = read_navigation(navigation).ephemerides
    assert len(theirs) == ephemerides
    by_key = {(e.satellite, e.iode, e.toe, e.health): e for e in ours}
    for e in theirs:
        found = by_key[e.satellite, e.iode, e.toe, e.health]
        for f in fields(e):
            if f.name not in NOT_IN_RINEX[type(e)]:
                assert numbers(getattr(found, f.name)) == pytest.approx(numbers(getattr(e, f.name)), rel=1e-11, abs=0.0), f.name
    assert {satellite_id(e.satellite)[0] for e in ours} - {satellite_id(e.satellite)[0] for e in theirs} == set(unknown_to_convbin)
