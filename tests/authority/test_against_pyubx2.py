"""Held against pyubx2: the same frames and the same values in every UBX recording."""

import gzip
import io
from collections.abc import Iterator
from math import isnan
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyubx2 import ERR_IGNORE, UBX_PROTOCOL, UBXReader

from rtkmesh.codecs.framing import Framer
from rtkmesh.codecs.messages import Frame, Protocol
from rtkmesh.codecs.ubx import NAV_PVT, RAWX, SFRBX, UbxDecoder
from rtkmesh.gnss.ephemeris import ReceiverFix
from rtkmesh.gnss.epoch import HALF_CYCLE, Epoch
from rtkmesh.gnss.signals import NO_CHANNEL, satellite_id, signal_code

SAMPLES = 12  # messages of a kind and recording that are compared; pyubx2 takes milliseconds for each

RECORDINGS = [
    *(f"dec_ubx/{name}" for name in (
        "gnss_imu_walk_1730.ubx", "pygpsdata-rxmsfrbx.log", "pygpsdata_testobsdata.log", "pygpsdata_testobsnavdata.log",
        "pygpsdata_testmetdata.log", "rxm_rawx.ubx", "rxm_sfrbx_glo.ubx", "nav_pvt.ubx", "nav_pvt_corrupted.ubx", "nav_pvt_fix_type.ubx",
    )),
    *(f"umea_f9p/{name}.ubx" for name in ("B001", "R001")),
    *(f"galway_m8p/{name}.ubx.gz" for name in (
        "base-20181004-1236", "base-20181004-1452", "base-20181015-1654", "rover-20181004-1237", "rover-20181004-1532",
        "rover-20181104-1634", "rover-20190416-1550", "rover-20190416-1617",
    )),
    *(f"dec_gpsd/ublox-{name}.log" for name in ("neo-m8t", "ned-m8t-sbfrx3", "zed-f9p_hpg1.11", "zed-f9p-hp", "zed-f9p-sfrbx", "zed-f9r")),
    *(f"sdq_f9p_2021/20210809-{name}-ubx-nmea-data.ubx" for name in ("114636", "115907", "121012", "122906")),
]  # fmt: skip

# RINEX code of (gnssId, sigId), written down here once more on purpose.
CODES = {
    (0, 0): "1C", (0, 3): "2L", (0, 4): "2S", (0, 6): "5I", (0, 7): "5Q", (1, 0): "1C", (2, 0): "1C", (2, 1): "1B", (2, 3): "5I",
    (2, 4): "5Q", (2, 5): "7I", (2, 6): "7Q", (2, 8): "6B", (3, 0): "2I", (3, 1): "2I", (3, 2): "7I", (3, 3): "7I", (3, 4): "6I",
    (3, 5): "1P", (3, 7): "5P", (5, 0): "1C", (5, 5): "2L", (6, 0): "1C", (6, 2): "2C",
}  # fmt: skip


def contents(path: Path) -> bytes:
    return gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()


def spread(frames: list[Frame], count: int) -> list[Frame]:
    return [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, count).astype(int))] if frames else []


def numbered(message: Any, name: str, index: int) -> Any:
    return getattr(message, f"{name}_{index:02d}")


def expected_rows(message: Any) -> Iterator[tuple[str, str, float, float, float, float]]:
    for i in range(1, message.numMeas + 1):
        gnss, sv = numbered(message, "gnssId", i), numbered(message, "svId", i)
        if gnss == 6 and sv == 255:
            continue
        number = sv - {1: 100}.get(gnss, 0)
        code = CODES[gnss, numbered(message, "sigId", i)]
        pseudorange = numbered(message, "prMes", i) if numbered(message, "prValid", i) else float("nan")
        phase = numbered(message, "cpMes", i) if numbered(message, "cpValid", i) else float("nan")
        yield f"{'GSEC?JRI'[gnss]}{number:02d}", code, pseudorange, phase, numbered(message, "doMes", i), numbered(message, "cno", i)


def check_epoch(epoch: Epoch, message: Any) -> None:
    assert (epoch.time.week, epoch.time.tow_s) == (message.week, message.rcvTow)
    rows = sorted(expected_rows(message), key=lambda row: ("GRECJSI".index(row[0][0]), row[0], row[1]))
    assert [row[:2] for row in epoch.rows()] == [row[:2] for row in rows]
    for found, expected in zip(epoch.rows(), rows, strict=True):
        assert all(a == b or (isnan(a) and isnan(b)) for a, b in zip(found[2:], expected[2:], strict=True)), (found, expected)
    check_quality(epoch, message)


def check_quality(epoch: Epoch, message: Any) -> None:
    at = {(satellite_id(int(epoch.satellite[k])), signal_code(int(epoch.signal[k]))): k for k in range(len(epoch))}
    i = 0
    for gnss, sv in ((numbered(message, "gnssId", n), numbered(message, "svId", n)) for n in range(1, message.numMeas + 1)):
        i += 1
        if gnss == 6 and sv == 255:
            continue
        k = at[f"{'GSEC?JRI'[gnss]}{sv - {1: 100}.get(gnss, 0):02d}", CODES[gnss, numbered(message, "sigId", i)]]
        assert epoch.lock_s[k] == pytest.approx(numbered(message, "locktime", i) * 1e-3)
        assert epoch.channel[k] == (numbered(message, "freqId", i) - 7 if gnss == 6 else NO_CHANNEL)
        assert epoch.pseudorange_sigma_m[k] == pytest.approx(0.01 * 2 ** numbered(message, "prStd", i))
        sigma = numbered(message, "cpStd", i)
        assert isnan(epoch.phase_sigma_cyc[k]) if sigma in (0, 15) else epoch.phase_sigma_cyc[k] == pytest.approx(0.004 * sigma)
        half_cycle = bool(numbered(message, "cpValid", i)) and not numbered(message, "halfCyc", i)
        assert bool(epoch.flags[k] & HALF_CYCLE) is half_cycle


def check_fix(fix: ReceiverFix, message: Any) -> None:
    assert (fix.satellites, fix.height_m) == (message.numSV, message.height / 1000)
    assert np.degrees([fix.lat_rad, fix.lon_rad]) == pytest.approx([message.lat, message.lon], abs=1e-9)
    assert fix.velocity_ned_mps == pytest.approx((message.velN / 1000, message.velE / 1000, message.velD / 1000))
    if fix.time is not None:
        assert fix.time.tow_s == pytest.approx(message.iTOW / 1000)


@pytest.mark.data
@pytest.mark.parametrize("name", RECORDINGS)
def test_values_of_a_recording_are_those_of_pyubx2(data: Path, name: str):
    """Some messages of each kind, spread over the recording: each value of RXM-RAWX and NAV-PVT is the same."""
    frames = Framer([Protocol.UBX]).feed(contents(data / name))
    decoder = UbxDecoder()
    compared = 0
    for kind in (RAWX, NAV_PVT):
        for frame in spread([frame for frame in frames if frame.kind == kind], SAMPLES):
            message = UBXReader.parse(frame.data)
            for found in decoder.decode(frame):
                if isinstance(found, Epoch):
                    check_epoch(found, message)
                    compared += 1
                elif isinstance(found, ReceiverFix):
                    check_fix(found, message)
                    compared += 1
    kinds = {frame.kind for frame in frames}
    assert compared > 0 or not kinds & {RAWX, NAV_PVT}


@pytest.mark.data
@pytest.mark.parametrize(
    "name", ["dec_ubx/rxm_sfrbx_gps.ubx", "dec_ubx/nav_pvt_fix_type.ubx", "dec_gpsd/ublox-zed-f9p-sfrbx.log", "dec_ubx/rxm_rawx.ubx"]
)
def test_frames_of_a_recording_are_those_of_pyubx2(data: Path, name: str):
    """pyubx2's reader finds the same UBX frames, byte for byte."""
    log = contents(data / name)
    reader = UBXReader(io.BytesIO(log), protfilter=UBX_PROTOCOL, quitonerror=ERR_IGNORE, parsing=False)
    expected = [bytes(raw) for raw, _ in reader]
    framer = Framer([Protocol.UBX])
    assert [frame.data for frame in framer.feed(log) + framer.flush()] == expected


@pytest.mark.data
def test_subframe_words_are_those_of_pyubx2(data: Path):
    """Satellite and words of RXM-SFRBX: our reading of the header agrees with pyubx2's."""
    frames = [f for f in Framer([Protocol.UBX]).feed(contents(data / "umea_f9p/B001.ubx")) if f.kind == SFRBX]
    for frame in spread(frames, 60):
        message = UBXReader.parse(frame.data)
        payload = frame.data[6:-2]
        assert (payload[0], payload[1], payload[3], payload[4]) == (message.gnssId, message.svId, message.freqId, message.numWords)
        words = np.frombuffer(payload, "<u4", message.numWords, 8).tolist()
        assert words == [numbered(message, "dwrd", i) for i in range(1, message.numWords + 1)]
