"""Antennas against RTKLIB's reader and ``antmodel`` (demo5 by PyPI pyrtklib5), and against numbers of the IGS's igs14.atx.

RTKLIB knows no azimuths: the shipped calibrations are given to both as their means.
"""

import subprocess
from dataclasses import replace
from math import radians
from pathlib import Path

import numpy as np
import pytest

from rtkmesh.codecs.antex import AntexFile, write_antex
from rtkmesh.codecs.rinex_navigation import read_navigation
from rtkmesh.codecs.rinex_observation import ObservationReader
from rtkmesh.gnss.antenna import AntennaCalibration
from rtkmesh.gnss.frames import enu_from_ecef_at
from rtkmesh.gnss.signals import GPS
from rtkmesh.models.antenna import Antenna, antenna_correction_m, antenna_of, carrier_place
from rtkmesh.models.ephemeris_table import EphemerisTable
from rtkmesh.rtk.engine import Rtk
from rtkmesh.rtk.options import Mode, RtkOptions
from rtkmesh_services.mapping.antennas import antenna_finder, shipped_antennas

# igs14.atx (IGS14_2134), as it stands there: north, east, up of G01 and of G02, NOAZI of G01 at zenith angles 0, 5, ... 30 degrees; mm.
RAW = {
    "LEIAR25.R3 NONE": ((1.18, 0.31, 161.38), (0.34, -0.46, 159.0), (0.0, 0.22, 0.84, 1.7, 2.59, 3.26, 3.55)),
    "ASH701945C_M NONE": ((0.07, -0.69, 89.92), (0.34, 0.39, 119.15), (0.0, -0.25, -0.97, -2.08, -3.46, -4.95, -6.38)),
    "TRM29659.00 UNAV": ((0.13, 0.44, 89.17), (0.51, 0.46, 117.16), (0.0, -0.26, -1.0, -2.15, -3.54, -5.03, -6.43)),
    "SEPCHOKE_B3E6 SPKE": ((-0.04, -0.44, 127.42), (-0.12, 0.25, 141.15), (0.0, -0.05, -0.19, -0.43, -0.79, -1.24, -1.76)),
    "LEIAR10 NONE": ((1.42, -0.25, 88.04), (0.61, 0.19, 81.17), (0.0, 0.03, 0.1, 0.15, 0.1, -0.08, -0.36)),
    "JAVRINGANT_DM SCIS": ((0.51, 0.83, 85.44), (0.24, 0.06, 115.05), (0.0, -0.38, -1.46, -3.06, -4.94, -6.81, -8.45)),
}


def mean(calibration: AntennaCalibration) -> AntennaCalibration:
    bands = (replace(band, variation_m=band.variation_m[:-1].mean(0, keepdims=True)) for band in calibration.bands)
    return replace(calibration, azimuth_step_deg=0.0, bands=tuple(bands)) if calibration.azimuth_step_deg else calibration


@pytest.mark.rtklib
def test_same_correction_as_rtklib(tmp_path: Path) -> None:
    """Every antenna of the shipped table, GPS L1 and L2, in directions all over the sky: equal to a micrometre."""
    rtklib = pytest.importorskip("pyrtklib5")
    file = tmp_path / "means.atx"
    file.write_text(write_antex(mean(calibration) for calibration in shipped_antennas()))
    calibrations = list(AntexFile(file.read_bytes()))
    theirs = rtklib.pcvs_t()
    assert rtklib.readpcv(str(file), theirs) == 1
    assert theirs.n == len(calibrations) > 350
    rng = np.random.default_rng(3)
    delta, azel, out = rtklib.Arr1Ddouble(3), rtklib.Arr1Ddouble(2), rtklib.Arr1Ddouble(3)
    compared = 0
    for index, calibration in enumerate(calibrations):
        ours, pcv = antenna_of(calibration), theirs.pcv[index]
        codes = [band.frequency for band in calibration.bands]
        for azimuth_rad, elevation_rad in zip(rng.uniform(0.0, 6.28, 4), rng.uniform(radians(1.0), radians(89.0), 4), strict=True):
            azel[0], azel[1] = azimuth_rad, elevation_rad
            rtklib.antmodel(pcv, delta, azel, 1, out)
            for theirs_at, code in enumerate(code for code in ("G01", "G02") if code in codes):
                place = carrier_place(ours.pattern, GPS, int(code[2]))
                got = antenna_correction_m(ours.pattern, place, azimuth_rad, elevation_rad)
                assert got == pytest.approx(out[theirs_at], abs=1e-6), (calibration.antenna, code)
                compared += 1
        del pcv
    rtklib.free_pcvs(theirs)
    assert compared > 2000


@pytest.mark.parametrize("name", RAW)
def test_shipped_numbers_are_those_of_the_igs(name: str) -> None:
    """Offsets as in the file to its last digit, the mean variation within the table's rounding and its fewer azimuths."""
    first, second, noazi = RAW[name]
    found = shipped_antennas().find(*name.split())
    assert found is not None
    bands = {band.frequency: band for band in found.bands}
    for code, north_east_up in (("G01", first), ("G02", second)):
        east, north, up = (1e3 * value for value in bands[code].offset_enu_m)
        assert (north, east, up) == pytest.approx(north_east_up, abs=1e-6)
    got = 1e3 * mean(found).bands[0].variation_m[0, : len(noazi)]
    assert got == pytest.approx(np.array(noazi), abs=0.12)


PAIR, PAIR_ROVER, PAIR_BASE = "geonet_2005", "07590920.05o", "30400920.05o"
PAIR_BASE_M = (-3978242.4348, 3382841.1715, 3649902.7667)
ANTENNAS = ("TRM29659.00     UNAV", "SEPCHOKE_B3E6   SPKE")  # not those of the recording: what they do is the same there
RNX2RTKP = """
pos1-posmode=static
pos1-frequency=l1+l2
pos1-elmask=15
pos1-ionoopt=brdc
pos1-tropopt=saas
pos1-navsys=1
pos1-posopt2=on
pos2-armode=continuous
out-solformat=xyz
out-timesys=gpst
ant2-postype=xyz
"""


def moved_by_rtklib(program: str, folder: Path, navigation: Path, rover: Path, base: Path) -> np.ndarray:
    """Return by how much (m, ECEF) antennas move the last position of rnx2rtkp."""
    (folder / "means.atx").write_text(write_antex(mean(calibration) for calibration in shipped_antennas()))
    options = RNX2RTKP + "".join(f"ant2-pos{k}={value}\n" for k, value in enumerate(PAIR_BASE_M, 1))
    antennas = "".join(f"ant{k}-anttype={name}\n" for k, name in enumerate(ANTENNAS, 1)) + f"file-rcvantfile={folder / 'means.atx'}\n"
    last = []
    for more in ("", antennas):
        conf, out = folder / "static.conf", folder / "out.pos"
        conf.write_text(options + more)
        command = [program, "-k", str(conf), "-o", str(out), str(rover), str(base), str(navigation)]
        subprocess.run(command, capture_output=True, check=True, timeout=120)
        last.append([float(value) for value in out.read_text().splitlines()[-1].split()[2:5]])
    return np.array(last[1]) - np.array(last[0])


def moved_by_us(navigation: Path, rover: Path, base: Path) -> np.ndarray:
    """Return by how much (m, ECEF) antennas move the engine's last position."""
    file, table = read_navigation(navigation.read_bytes()), EphemerisTable()
    for ephemeris in file.ephemerides:
        table.add(ephemeris)
    epochs = [list(ObservationReader(path.read_bytes())) for path in (rover, base)]
    options = RtkOptions(mode=Mode.STATIC, systems="G", frequencies=2)
    klobuchar = next(one for one in file.klobuchar if one.system == "G")
    last = []
    for names in ((), ANTENNAS):
        engine, found = Rtk(options), [antenna_finder()(name, "") for name in names]
        engine.antennas(*(one if isinstance(one, Antenna) else None for one in found or ("", "")))
        steps = [engine.step(r, b, table, klobuchar, base_position_ecef_m=np.array(PAIR_BASE_M)) for r, b in zip(*epochs, strict=True)]
        last.append(steps[-1].position_ecef_m)
    return last[1] - last[0]


@pytest.mark.rtklib
@pytest.mark.data
def test_a_mixed_pair_moves_as_it_does_in_rtklib(data: Path, rtklib_program, tmp_path: Path) -> None:
    """Three kilometres, fixed: both engines put the rover 28 mm higher with antennas, and weigh the satellites differently."""
    rover, base, navigation = (data / PAIR / name for name in (PAIR_ROVER, PAIR_BASE, "07590920.05n"))
    turn = enu_from_ecef_at(np.array(PAIR_BASE_M))
    theirs = turn @ moved_by_rtklib(rtklib_program("rnx2rtkp"), tmp_path, navigation, rover, base)
    ours = turn @ moved_by_us(navigation, rover, base)
    assert 0.025 < theirs[2] < 0.035
    assert ours == pytest.approx(theirs, abs=0.004)
