"""Receiver options against RTKLIB on real recordings, convbin 2.4.3 (``-ro``) and demo5 (pyrtklib5): the same text, the same values."""

import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from rtkmesh.codecs.messages import Message
from rtkmesh.codecs.rinex_navigation import read_navigation
from rtkmesh.codecs.rinex_observation import ObservationReader
from rtkmesh.codecs.stream import StreamDecoder, StreamOptions
from rtkmesh.gnss.ephemeris import GlonassEphemeris, KeplerEphemeris
from rtkmesh.gnss.epoch import SLIP, Epoch
from rtkmesh.gnss.receiver_options import parse_receiver_options
from rtkmesh.gnss.signals import carrier_hz, signal_number
from rtkmesh.gnss.time import GpsTime

pytestmark = [pytest.mark.data, pytest.mark.rtklib]

UBX = "umea_f9p/R001.ubx"
RTCM3 = "dec_rtcm3/msm7.rtcm"
NEAR = GpsTime.from_calendar(2018, 7, 13, 9)  # of that
BYTES = 120_000
PRINTED = 6e-4
NO_PHASE_CYC = 1e7  # with -TADJ RTKLIB moves phases that are not there
ALWAYS = " -MAX_STD_CP=5"  # what convbin does unless it is told otherwise


def converted(source: Path, folder: Path, convbin: str, form: str, options: str, date: str) -> tuple[list[Epoch], Path]:
    (folder / "log").write_bytes(source.read_bytes()[:BYTES])
    command = [convbin, "-r", form, "-v", "3.04", "-od", "-os", "-tr", *date.split(), "-o", "log.obs", "-n", "log.nav"]
    command += ["-ro", options] if options else []
    subprocess.run([*command, "log"], cwd=folder, check=True, capture_output=True, timeout=60)
    observed = folder / "log.obs"
    return list(ObservationReader(observed.read_bytes())) if observed.exists() else [], folder / "log.nav"


def messages_of(source: Path, options: str, near: GpsTime) -> list[Message]:
    decoder = StreamDecoder(StreamOptions(approximate_time=near, receiver=parse_receiver_options(options)))
    return [message for _, found in decoder.feed(source.read_bytes()[:BYTES]) for message in found] + decoder.flush()


def keys_of(epoch: Epoch) -> NDArray[np.int64]:
    """Return a number for satellite and signal of each row; demo5 calls u-blox' E1C 1X, and L2CL of GPS 2X."""
    signal = epoch.signal.copy()
    for system, theirs, ours in ((2, "1X", "1C"), (0, "2X", "2L"), (2, "7X", "7Q")):
        signal[(epoch.satellite // 64 == system) & (signal == signal_number(theirs))] = signal_number(ours)
    return epoch.satellite.astype(np.int64) * 512 + signal


def assert_same(ours: list[Epoch], theirs: list[Epoch], share: float = 1.0) -> int:
    """Hold the rows of theirs against ours, which must have at least this share of them; return their number."""
    by_time = {round(epoch.time.tow_s, 6): epoch for epoch in ours}
    rows = 0
    for b in theirs:
        a = by_time[round(b.time.tow_s, 6)]
        _, i, j = np.intersect1d(keys_of(a), keys_of(b), return_indices=True)
        assert len(j) >= share * len(b)
        clock_m = np.median(a.pseudorange_m[i] - b.pseudorange_m[j]) if len(i) else 0.0
        assert abs(clock_m) < 0.03
        clock_cyc = clock_m * np.array([carrier_hz(int(a.satellite[k]), int(a.signal[k]), int(a.channel[k])) for k in i]) / 299_792_458.0
        np.testing.assert_allclose(a.pseudorange_m[i] - clock_m, b.pseudorange_m[j], rtol=0.0, atol=2.0 * PRINTED)
        phase_cyc = np.where(np.isnan(a.phase_cyc[i]) & (np.abs(b.phase_cyc[j]) < NO_PHASE_CYC), np.nan, b.phase_cyc[j])
        np.testing.assert_allclose(a.phase_cyc[i] - clock_cyc, phase_cyc, rtol=0.0, atol=6.0 * PRINTED)
        np.testing.assert_allclose(a.doppler_hz[i], b.doppler_hz[j], rtol=0.0, atol=1.1e-3)
        rows += len(j)
    return rows


@pytest.mark.parametrize("options", ["", "-TADJ=0.1", "-TADJ=1", "-MULTICODE -RCVSTDS"])
def test_ubx_measurements_are_those_of_convbin(data: Path, tmp_path: Path, rtklib_program: Callable[[str], str], options: str):
    """Rounded times. RTKLIB's own times are good to 1e-10 s: all ranges of an epoch may differ by the same few centimetres."""
    theirs, _ = converted(data / UBX, tmp_path, rtklib_program("convbin"), "ubx", options, "2021/12/09 12:00:00")
    ours = [
        message for message in messages_of(data / UBX, options + ALWAYS, GpsTime.from_calendar(2021, 12, 9)) if isinstance(message, Epoch)
    ]
    assert assert_same(ours, theirs) > 1000


@pytest.mark.parametrize("options", ["-MAX_STD_CP=3", "-MAX_STD_CP=15", "-MAX_STD_CP=15 -STD_SLIP=3", "-MAX_STD_CP=5 -INVCP"])
def test_ubx_measurements_are_those_of_demo5(data: Path, demo5: Callable[..., tuple[list[Epoch], object]], options: str):
    """Phases left out, and slips marked, by the receiver's sigma; -INVCP changes nothing in RXM-RAWX. (Slips by lock times differ.)"""
    content, wanted = (data / UBX).read_bytes()[:100_000], parse_receiver_options(options)
    theirs, _ = demo5("ubx", content, options)
    decoder = StreamDecoder(StreamOptions(receiver=wanted))
    ours = {round(m.time.tow_s, 6): m for _, found in decoder.feed(content) for m in found if isinstance(m, Epoch)}
    assert assert_same(list(ours.values()), theirs, 0.9) > 500
    marked = 0
    for b in theirs if wanted.slip_sigma else []:
        a = ours[round(b.time.tow_s, 6)]
        _, i, j = np.intersect1d(keys_of(a), keys_of(b), return_indices=True)
        bad = (a.phase_sigma_cyc[i] > 0.004 * wanted.slip_sigma - 0.002) & np.isfinite(a.phase_cyc[i])
        assert ((a.flags[i] & SLIP) > 0)[bad].all()
        assert ((b.flags[j] & SLIP) > 0)[bad].all()
        marked += int(bad.sum())
    assert marked > 50 or not wanted.slip_sigma


@pytest.mark.parametrize("options", ["-STA=0", "-STA=1"])
def test_one_stations_messages_are_those_of_convbin(data: Path, tmp_path: Path, rtklib_program: Callable[[str], str], options: str):
    """The recording is of station 0."""
    theirs, _ = converted(data / RTCM3, tmp_path, rtklib_program("convbin"), "rtcm3", options, "2018/07/13 09:00:00")
    ours = [message for message in messages_of(data / RTCM3, options, NEAR) if isinstance(message, Epoch)]
    assert len(ours) == len(theirs)
    assert (assert_same(ours, theirs) > 1000) is (options == "-STA=0")


@pytest.mark.parametrize("options", ["", "-INVPRR"])
def test_turned_dopplers_are_those_of_demo5(data: Path, demo5: Callable[..., tuple[list[Epoch], object]], options: str):
    """(convbin 2.4.3 does not know this option.)"""
    content = (data / RTCM3).read_bytes()[:20_000]
    theirs, _ = demo5("rtcm3", content, options, NEAR)
    ours = [message for message in messages_of(data / RTCM3, options, NEAR) if isinstance(message, Epoch)]
    assert assert_same(ours, theirs, 0.9) > 300


@pytest.mark.parametrize(("options", "messages"), [("-EPHALL", 2), ("-EPHALL -GALINAV", 1), ("-EPHALL -GALFNAV", 1)])
def test_ephemerides_are_those_of_convbin(data: Path, tmp_path: Path, rtklib_program: Callable[[str], str], options: str, messages: int):
    """eph.rtcm: every ephemeris that convbin writes is passed on; of Galileo only the kind that is wanted."""
    source, near = data / "dec_rtcm3" / "eph.rtcm", GpsTime.from_calendar(2018, 8, 3, 15, 30)
    _, navigation = converted(source, tmp_path, rtklib_program("convbin"), "rtcm3", options, "2018/08/03 15:30:00")
    theirs = read_navigation(navigation.read_bytes()).ephemerides
    ours = [m for m in messages_of(source, options, near) if isinstance(m, KeplerEphemeris | GlonassEphemeris)]
    keys = [{(e.satellite, getattr(e, "message", None), e.toe) for e in found} for found in (ours, theirs)]
    assert keys[1] <= keys[0]
    assert len({e.message for e in ours if isinstance(e, KeplerEphemeris) and e.satellite // 64 == 2}) == messages
