"""RTCM 3 decoding and encoding against RTKLIB's convbin: the same bytes must give the same RINEX values.

Explained differences: convbin 2.4.3 b34 loses the week on week-rollover-STR17 (data README, section 4), rounds C/N0 to a quarter of a
dB-Hz, and writes GLONASS phases in a frequency channel of its own where none was sent.
"""

import subprocess
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest

from rtkmesh.codecs.framing import Framer
from rtkmesh.codecs.messages import Message, Protocol
from rtkmesh.codecs.rinex_navigation import read_navigation
from rtkmesh.codecs.rinex_observation import ObservationReader
from rtkmesh.codecs.rtcm3 import Rtcm3Decoder
from rtkmesh.codecs.rtcm3_encode import encode_ephemeris, encode_epoch, encode_glonass_bias, encode_station
from rtkmesh.gnss.ephemeris import Ephemeris, GlonassBias, GlonassEphemeris, KeplerEphemeris, ReferenceStation
from rtkmesh.gnss.epoch import SLIP, Epoch
from rtkmesh.gnss.signals import GLONASS, NO_CHANNEL, satellite_id
from rtkmesh.gnss.time import GpsTime

pytestmark = [pytest.mark.rtklib]

PRINTED = 0.00051  # RINEX has three decimals
DOPPLER = 0.001  # convbin keeps it in single precision
CN0_STEP = 0.126  # convbin keeps quarters of a dB-Hz


def decode(data: bytes, near: GpsTime) -> list[Message]:
    framer, decoder = Framer([Protocol.RTCM3]), Rtcm3Decoder(near)
    messages = [message for frame in framer.feed(data) + framer.flush() for message in decoder.decode(frame)]
    return messages + decoder.flush()


def epochs_of(messages: Iterable[Message]) -> list[Epoch]:
    return [message for message in messages if isinstance(message, Epoch)]


def convbin(program: str, source: Path, folder: Path, date: str) -> tuple[Path, Path]:
    observations, navigation = folder / "out.obs", folder / "out.nav"
    command = [program, "-r", "rtcm3", "-v", "3.04", "-od", "-os", "-tr", *date.split(), "-o", observations, "-n", navigation, str(source)]
    subprocess.run(command, check=True, capture_output=True, cwd=folder, timeout=120)
    return observations, navigation


def paired(ours: list[Epoch], theirs: list[Epoch]) -> list[tuple[Epoch, Epoch]]:
    """Return the epochs of equal time, without the first, which may be cut; only the last one may have no partner."""
    by_time = {round(epoch.time.tow_s, 3): epoch for epoch in theirs}
    pairs = [(epoch, by_time[key]) for epoch in ours if (key := round(epoch.time.tow_s, 3)) in by_time]
    assert len(pairs) >= len(ours) - 1
    assert len(pairs) == len(theirs)
    return pairs[1:]


def differences(pairs: list[tuple[Epoch, Epoch]]) -> tuple[int, dict[str, float], int]:
    """Return the number of equal rows, the largest difference by column, and the rows that only one side has."""
    largest = {"pseudorange_m": 0.0, "phase_cyc": 0.0, "doppler_hz": 0.0, "cn0_dbhz": 0.0}
    equal = lonely = 0
    for a, b in pairs:
        key_a, key_b = a.satellite.astype(int) * 512 + a.signal, b.satellite.astype(int) * 512 + b.signal
        _, i, j = np.intersect1d(key_a, key_b, return_indices=True)
        equal += len(i)
        lonely += len(a) + len(b) - 2 * len(i)
        for name in largest:
            x, y = getattr(a, name)[i], getattr(b, name)[j]
            if name == "phase_cyc":
                x = np.where((a.satellite[i] // 64 == GLONASS) & (a.channel[i] == NO_CHANNEL), np.nan, x)
                y = np.where(np.isnan(x), np.nan, y)
            assert (np.isfinite(x) <= np.isfinite(y)).all(), f"{name}: we have values that convbin has not"
            largest[name] = max(largest[name], float(np.nanmax(np.abs(x - y), initial=0.0)))
    return equal, largest, lonely


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "date", "near"),
    [
        ("piksi-5Hz.rtcm3", "2018/07/17 08:00:00", (2018, 7, 17)),
        ("piksi-2Hz.rtcm3", "2018/07/16 12:00:00", (2018, 7, 16)),
        ("msm7.rtcm", "2018/07/13 09:00:00", (2018, 7, 13)),
        ("sept.rtcm", "2018/07/11 00:00:00", (2018, 7, 11)),
        ("leica.rtcm", "2018/07/10 18:00:00", (2018, 7, 10)),
        ("geo++_TRM.rtcm", "2018/07/11 17:00:00", (2018, 7, 11)),
        ("week-rollover-STR24.rtcm3", "2018/07/14 23:00:00", (2018, 7, 14)),
    ],
)
def test_observations_equal_those_of_convbin(
    data: Path, rtklib_program: Callable[[str], str], tmp_path: Path, name: str, date: str, near: tuple[int, int, int]
) -> None:
    """Every value of every epoch of MSM4, MSM5 and MSM7 files is that of convbin to the last printed digit."""
    source = data / "dec_rtcm3" / name
    theirs_path, _ = convbin(rtklib_program("convbin"), source, tmp_path, date)
    ours, theirs = epochs_of(decode(source.read_bytes(), GpsTime.from_calendar(*near))), list(ObservationReader(theirs_path.read_bytes()))
    equal, largest, lonely = differences(paired(ours, theirs))
    assert equal > 100
    assert lonely == 0
    assert max(largest["pseudorange_m"], largest["phase_cyc"]) < PRINTED
    assert largest["doppler_hz"] < DOPPLER
    assert largest["cn0_dbhz"] < CN0_STEP
