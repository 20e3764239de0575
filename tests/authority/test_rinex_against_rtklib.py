"""RINEX observation and navigation files of the recordings: our values equal those of RTKLIB's reader (demo5 2.5.1, pyrtklib5)."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hatanaka
import numpy as np
import pytest

from rtkmesh.codecs.rinex_navigation import read_navigation
from rtkmesh.codecs.rinex_observation import ObservationReader
from rtkmesh.gnss.ephemeris import Ephemeris, GlonassEphemeris, KeplerEphemeris, NavigationMessage
from rtkmesh.gnss.epoch import HALF_CYCLE, SLIP, Epoch
from rtkmesh.gnss.signals import GALILEO, SYSTEMS, satellite_id, satellite_number, signal_number, system_of
from rtkmesh.gnss.time import GpsTime

rtklib = pytest.importorskip("pyrtklib5")
pytestmark = [pytest.mark.data, pytest.mark.rtklib]

_GPST0 = 315964800  # 1980-01-06 in RTKLIB's time_t

OBSERVATION_FILES = (
    "tokyo_static/rover.obs",
    "kanagawa_2021_078_60s/SEPT078M1.21O",
    "kanagawa_2021_078_60s/3034078M1.21O",
    "geonet_2005/07590920.05o",
    "yamatogawa_walk/yamatogawa_master.obs",
    "yamatogawa_walk/yamatogawa_rover.obs",
    "galway_m8p/glw1277m.18o",
    "nl_cors_2021_001/delf0010.21d",
)
NAVIGATION_FILES = (
    "tokyo_static/base.nav",
    "kanagawa_2021_078_60s/SEPT078M.21P",
    "geonet_2005/07590920.05n",
    "galway_m8p/glw1277m.18n",
    "galway_m8p/glw1277m.18g",
    "yamatogawa_walk/brdc0060.10n",
    "nl_cors_2021_001/CBW100NLD_R_20210010000_01D_MN.rnx",
)


def read_with_rtklib(path: Path) -> tuple[Any, Any, Any]:
    observations, navigation, station = rtklib.obs_t(), rtklib.nav_t(), rtklib.sta_t()
    assert rtklib.readrnx(str(path), 1, "", observations, navigation, station) >= 0
    return observations, navigation, station


def satellites() -> dict[int, int]:
    """Return our satellite numbers by RTKLIB's."""
    ids = [f"{system}{number:02d}" for system in SYSTEMS for number in range(1, 64)]
    return {rtklib.satid2no(name): satellite_number(name) for name in ids if rtklib.satid2no(name)}


def gps_time(time: Any) -> GpsTime:
    return GpsTime.normalized(0, 0.0) + (time.time - _GPST0 + time.sec)


def plain(path: Path, folder: Path) -> Path:
    """Return the file itself, or its text if it is Hatanaka-compressed (RTKLIB's reader cannot read that)."""
    if not path.name.endswith("d"):
        return path
    text = folder / (path.name[:-1] + "o")
    text.write_bytes(hatanaka.decompress(path.read_bytes()))
    return text


def thinned(path: Path, folder: Path, size: int = 500_000) -> Path:
    """Return the file cut behind ``size`` bytes (at an end of line), to bound the time of the comparison."""
    text = path.read_bytes()
    if len(text) <= size:
        return path
    cut = folder / ("cut_" + path.name)
    cut.write_bytes(text[: text.index(b"\n", size) + 1])
    return cut


def rtklib_rows(observations: Any) -> Iterator[tuple[GpsTime, int, str, float, float, float, float, int]]:
    """Yield (time, satellite, code, P, L, D, S, LLI) of all observations."""
    ours = satellites()
    for i in range(observations.n):
        row = observations.data[i]
        pseudoranges, phases, dopplers = list(row.P), list(row.L), list(row.D)
        for k in range(3):
            if row.code[k]:
                values = (pseudoranges[k], phases[k], dopplers[k], row.SNR[k], row.LLI[k])
                yield gps_time(row.time), ours[row.sat], rtklib.code2obs(row.code[k]), *values


@pytest.mark.parametrize("name", OBSERVATION_FILES)
def test_observations_equal_rtklibs(name: str, data: Path, tmp_path: Path) -> None:
    """Every pseudorange, phase, Doppler, C/N0 and LLI that RTKLIB keeps is in our epochs with the same bits, under the same signal."""
    path = thinned(plain(data / name, tmp_path), tmp_path)
    reader = ObservationReader(path.read_bytes())
    version_2 = reader.header.version < 3.0
    by_time: dict[int, Epoch] = {}
    for epoch in reader:
        by_time[round((epoch.time - GpsTime(0, 0.0)) * 1e4)] = epoch
    observations, _, _ = read_with_rtklib(path)
    rows = 0
    for time, satellite, code, pseudorange, phase, doppler, strength, lli in rtklib_rows(observations):
        epoch = by_time.get(round((time - GpsTime(0, 0.0)) * 1e4))
        if epoch is None:  # the cut epoch at the end: RTKLIB keeps part of it
            assert time - max(e.time for e in by_time.values()) > 0.0
            continue
        candidates = [
            i
            for i in range(len(epoch))
            if epoch.satellite[i] == satellite
            and (version_2 or epoch.signal[i] == signal_number(code))
            and signal_band(epoch, i) == int(code[0])
        ]
        label = f"{name} {time} {satellite_id(satellite)} {code}"
        assert candidates or pseudorange == phase == doppler == 0.0, label
        for theirs, column in ((pseudorange, epoch.pseudorange_m), (phase, epoch.phase_cyc), (doppler, epoch.doppler_hz)):
            single = column is epoch.doppler_hz  # RTKLIB keeps Doppler in single precision
            values = [float(np.float32(column[i]) if single else column[i]) for i in candidates]
            assert theirs == 0.0 or theirs in values, f"{label}: {theirs} {values}"
        with_phase = [i for i in candidates if phase and epoch.phase_cyc[i] == phase]
        for i in with_phase:
            assert epoch.flags[i] == lli & (SLIP | HALF_CYCLE), label
            assert strength == 0.0 or math.isclose(strength, float(epoch.cn0_dbhz[i]), abs_tol=1e-3), label
        rows += 1
    assert rows > 100


def signal_band(epoch: Epoch, row: int) -> int:
    return int(epoch.signal[row]) // 26


@pytest.mark.parametrize("name", OBSERVATION_FILES[:1])
def test_station_equals_rtklibs(name: str, data: Path) -> None:
    """The header's position is RTKLIB's."""
    header = ObservationReader((data / name).read_bytes()).header
    _, _, station = read_with_rtklib(data / name)
    assert header.position_ecef_m == tuple(station.pos[k] for k in range(3))


KEPLER_FIELDS = (
    ("e", "eccentricity"), ("M0", "m0_rad"), ("deln", "delta_n_radps"), ("OMG0", "omega0_rad"), ("omg", "omega_rad"),
    ("OMGd", "omega_dot_radps"), ("i0", "i0_rad"), ("idot", "idot_radps"), ("cuc", "cuc_rad"), ("cus", "cus_rad"), ("crc", "crc_m"),
    ("crs", "crs_m"), ("cic", "cic_rad"), ("cis", "cis_rad"), ("f0", "af0_s"), ("f1", "af1"), ("f2", "af2"), ("svh", "health"),
    ("iode", "iode"),
)  # fmt: skip


def close(a: GpsTime, b: GpsTime) -> bool:
    return abs(a - b) < 1e-6


def same_kepler(theirs: Any, ours: KeplerEphemeris) -> None:
    for name, mine in KEPLER_FIELDS:
        assert getattr(theirs, name) == getattr(ours, mine), name
    assert ours.sqrt_a * ours.sqrt_a == theirs.A
    for name, mine in (("toe", ours.toe), ("toc", ours.toc), ("ttr", ours.transmitted)):
        assert close(gps_time(getattr(theirs, name)), mine), name
    assert theirs.tgd[0] == ours.group_delay_s[0]
    if ours.message in (NavigationMessage.INAV, NavigationMessage.D1, NavigationMessage.D2):
        assert theirs.tgd[1] == ours.group_delay_s[1]
    if ours.message not in (NavigationMessage.INAV, NavigationMessage.FNAV):
        assert theirs.iodc == ours.iodc


def same_glonass(theirs: Any, ours: GlonassEphemeris) -> None:
    assert (theirs.frq, theirs.svh, theirs.age) == (ours.channel, ours.health, ours.age_days)
    assert (-theirs.taun, theirs.gamn) == (ours.tau_s, ours.gamma)
    assert tuple(theirs.pos) == ours.position_m
    assert tuple(theirs.vel) == ours.velocity_mps
    assert tuple(theirs.acc) == ours.acceleration_mps2
    assert close(gps_time(theirs.toe), ours.toe)
    assert close(gps_time(theirs.tof), ours.transmitted)


def rtklib_ephemerides(navigation: Any) -> dict[tuple[int, int, int, int], Any]:
    """Return RTKLIB's ephemerides by (our satellite, toe in seconds, issue, Galileo message)."""
    ours, found = satellites(), {}
    for i in range(navigation.n):
        row = navigation.eph[i]
        if row.sat:
            fnav = int(system_of(ours[row.sat]) == GALILEO and bool(row.code & 1 << 8))
            found[ours[row.sat], round(gps_time(row.toe) - GpsTime(0, 0.0)), row.iode, fnav] = row
    for i in range(navigation.ng):
        row = navigation.geph[i]
        if row.sat:
            found[ours[row.sat], round(gps_time(row.toe) - GpsTime(0, 0.0)), row.iode, 0] = row
    return found


def key(ephemeris: Ephemeris) -> tuple[int, int, int, int]:
    fnav = int(isinstance(ephemeris, KeplerEphemeris) and ephemeris.message == NavigationMessage.FNAV)
    return ephemeris.satellite, round(ephemeris.toe - GpsTime(0, 0.0)), ephemeris.iode, fnav


@pytest.mark.parametrize("name", NAVIGATION_FILES)
def test_ephemerides_equal_rtklibs(name: str, data: Path) -> None:
    """Every number of every ephemeris equals RTKLIB's; the times too, in GPST."""
    file = read_navigation((data / name).read_bytes())
    assert not file.counters.rejected
    _, navigation, _ = read_with_rtklib(data / name)
    theirs = rtklib_ephemerides(navigation)
    ours: dict[tuple[int, int, int, int], list[Ephemeris]] = {}
    for ephemeris in file.ephemerides:
        ours.setdefault(key(ephemeris), []).append(ephemeris)
    assert len(theirs) > 10
    for identity, their in theirs.items():
        assert identity in ours, f"{satellite_id(identity[0])} {identity}"
        assert any(matches(their, our) for our in ours[identity]), f"{satellite_id(identity[0])} {identity}"


def matches(theirs: Any, ours: Ephemeris) -> bool:
    try:
        same_kepler(theirs, ours) if isinstance(ours, KeplerEphemeris) else same_glonass(theirs, ours)
    except AssertionError:
        return False
    return True
