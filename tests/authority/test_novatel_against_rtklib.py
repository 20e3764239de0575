"""NovAtel's binary logs against RTKLIB demo5 (pyrtklib5) and RTKLIB 2.4.3 (convbin): what was encoded here, read by all three alike.

No recording of NovAtel data is among ours: the measurements are those of the simulated demo rover. pyrtklib5 holds three signals of a
satellite, one of each frequency, and drops GLONASS where the half cycle is open; convbin 2.4.3 b34 knows fewer signals and satellites.
"""

import subprocess
from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtkmesh.codecs import novatel_encode as encode
from rtkmesh.codecs.novatel_signals import SIGNALS
from rtkmesh.codecs.rinex_navigation import read_navigation
from rtkmesh.codecs.rinex_observation import ObservationReader
from rtkmesh.codecs.stream import StreamDecoder
from rtkmesh.codecs.unicore_signals import SATELLITES
from rtkmesh.gnss.ephemeris import GlonassEphemeris, KeplerEphemeris
from rtkmesh.gnss.epoch import SLIP, Epoch, make_epoch
from rtkmesh.gnss.signals import GPS, SATELLITES_PER_SYSTEM, satellite_id, signal_code, signal_number
from rtkmesh.gnss.time import GpsTime
from rtkmesh.simulation.scenario import open_stream
from rtkmesh.simulation.sky import broadcast

START = GpsTime(2445, 532_800.0)
EPOCHS = 12
Demo5 = Callable[..., tuple[list[Epoch], dict[int, Any]]]
# Fields of ours -> RTKLIB's.
KEPLER = {
    "m0_rad": "M0", "delta_n_radps": "deln", "omega0_rad": "OMG0", "omega_rad": "omg", "omega_dot_radps": "OMGd", "i0_rad": "i0",
    "idot_radps": "idot", "eccentricity": "e", "cuc_rad": "cuc", "cus_rad": "cus", "crc_m": "crc", "crs_m": "crs", "cic_rad": "cic",
    "cis_rad": "cis", "af0_s": "f0", "af1": "f1", "af2": "f2", "iode": "iode", "health": "svh",
}  # fmt: skip


@pytest.fixture(scope="module")
def simulated() -> tuple[list[Epoch], list[bytes]]:
    """Epochs of the demo's rover, some with lock times that fell, and the logs of their satellites' ephemerides."""
    stream = open_stream("demo", "rover", seed=1, rate_hz=1.0, start=START)
    receiver = stream.receiver()
    epochs = [
        replace(epoch, time=GpsTime(epoch.time.week, round(epoch.time.tow_s * 1e3) / 1e3))
        for epoch in (receiver.observe(tag).epoch for tag in islice(stream.tags(), EPOCHS))
    ]
    epochs = [replace(e, lock_s=np.where(np.arange(len(e)) % 7 == k % 7, 0.2, 50.0 + k)) for k, e in enumerate(epochs)]
    logs: list[bytes] = []
    for satellite in sorted({int(s) for epoch in epochs for s in epoch.satellite}):
        e = broadcast(satellite, START)
        gps = isinstance(e, KeplerEphemeris) and satellite // SATELLITES_PER_SYSTEM == GPS
        logs.append(encode.encode_raw_ephemeris(e, START) if gps else encode.encode_ephemeris(e, START))
    return epochs, logs


def ours(data: bytes) -> tuple[list[Epoch], dict[int, Any]]:
    messages = [message for _, found in StreamDecoder().feed(data) for message in found]
    ephemerides = {m.satellite: m for m in messages if isinstance(m, KeplerEphemeris | GlonassEphemeris)}
    return [m for m in messages if isinstance(m, Epoch)], ephemerides


def rows_of(epoch: Epoch) -> dict[tuple[str, str], tuple[float, float, float, float, bool]]:
    return {
        (satellite, code): (*values, bool(flag & SLIP))
        for (satellite, code, *values), flag in zip(epoch.rows(), epoch.flags.tolist(), strict=True)
    }


@pytest.mark.parametrize("log", [encode.encode_observations, encode.encode_compressed])
def test_observations_are_read_as_demo5_reads_them(simulated: tuple[list[Epoch], list[bytes]], demo5: Demo5, log: Callable[[Epoch], bytes]):
    """Every value and slip of every signal that it keeps: the phases of RANGECMP with their rolls, to the last bit of it."""
    epochs, logs = simulated
    data = b"".join([*logs, *(log(epoch) for epoch in epochs)])
    (found, _), (expected, _) = ours(data), demo5("oem4", data)
    assert [e.time for e in found] == [e.time for e in epochs]
    assert len(expected) == EPOCHS
    compared = slips = 0
    for mine, theirs in zip(found, expected, strict=True):
        assert mine.time - theirs.time == pytest.approx(0.0, abs=1e-6)
        own = rows_of(mine)
        for key, (code_m, phase_cyc, doppler_hz, cn0_dbhz, slipped) in rows_of(theirs).items():
            assert own[key][:2] == (code_m, pytest.approx(phase_cyc, abs=1e-6, nan_ok=True))
            assert own[key][2:4] == pytest.approx((doppler_hz, cn0_dbhz), abs=2e-3)
            assert own[key][4] == (slipped and np.isfinite(phase_cyc))
            compared, slips = compared + 1, slips + slipped
    assert compared > 600
    assert slips > 60


def test_ephemerides_are_read_as_demo5_reads_them(simulated: tuple[list[Epoch], list[bytes]], demo5: Demo5):
    """All values of GPS (raw), Galileo and BeiDou."""
    data = b"".join(simulated[1])
    (_, found), (_, expected) = ours(data), demo5("oem4", data)
    assert {satellite // SATELLITES_PER_SYSTEM for satellite in expected} == {0, 2, 3}
    assert set(expected) == {satellite for satellite, e in found.items() if isinstance(e, KeplerEphemeris)}
    for satellite, theirs in expected.items():
        for name, other in KEPLER.items():
            assert getattr(found[satellite], name) == pytest.approx(getattr(theirs, other), rel=1e-15), (satellite, name)
        assert found[satellite].sqrt_a ** 2 == pytest.approx(theirs.A, rel=1e-14)


@pytest.mark.parametrize("number", [0, 1, 3, 4, 5])
def test_signals_have_demo5s_names(number: int, demo5: Demo5):
    """Each signal type of GPS, GLONASS, Galileo, BeiDou and QZSS, one at a time: it keeps some in the same place."""
    agreed = 0
    for system_number, system, first, _, offset in SATELLITES:
        if system_number != number or (number == 5 and first == 1):  # it wants the PRNs of QZSS
            continue
        satellite = system * SATELLITES_PER_SYSTEM + first - offset
        for code in SIGNALS[number].values():
            epoch = make_epoch(
                START, satellite=[satellite], signal=[signal_number(code)], channel=[0], pseudorange_m=[2e7], phase_cyc=[1e8]
            )
            data = encode.encode_observations(epoch)
            ((mine,), _), (theirs, _) = ours(data), demo5("oem4", data)
            expected = [(satellite_id(satellite), code)]
            assert [(satellite_id(int(s)), signal_code(int(c))) for s, c in zip(mine.satellite, mine.signal, strict=True)] == expected
            if theirs:
                assert [row[:2] for row in theirs[0].rows()] == expected
                agreed += 1
    assert agreed >= 3  # the others have no place in this build


@pytest.mark.rtklib
def test_convbin_reads_the_stream_as_we_do(
    simulated: tuple[list[Epoch], list[bytes]], rtklib_program: Callable[[str], str], tmp_path: Path
):
    """What convbin 2.4.3 knows of the stream: values to its three decimals, orbits to its twelve digits."""
    epochs, logs = simulated
    data = b"".join([*logs, *(encode.encode_observations(epoch) for epoch in epochs)])
    (tmp_path / "rover.nov").write_bytes(data)
    subprocess.run(
        [rtklib_program("convbin"), "rover.nov", "-r", "nov", "-od", "-os", "-o", "rover.obs", "-n", "rover.nav", "-v", "3.04", "-f", "5"],
        cwd=tmp_path, check=True, capture_output=True, timeout=60,
    )  # fmt: skip
    found, own_orbits = ours(data)
    expected = list(ObservationReader((tmp_path / "rover.obs").read_bytes()))
    compared = 0
    assert [e.time for e in expected] == [e.time for e in found]
    for mine, theirs in zip(found, expected, strict=True):
        own = rows_of(mine)
        for key, values in rows_of(theirs).items():
            if key in own:
                assert own[key][:3] == pytest.approx(values[:3], abs=6e-4, nan_ok=True)
                compared += 1
    assert compared > 400
    orbits = [e for e in read_navigation((tmp_path / "rover.nav").read_bytes()).ephemerides if isinstance(e, KeplerEphemeris)]
    assert len(orbits) > 8
    for orbit in orbits:
        for name in ("m0_rad", "eccentricity", "sqrt_a", "omega0_rad", "i0_rad", "af0_s"):
            assert getattr(orbit, name) == pytest.approx(getattr(own_orbits[orbit.satellite], name), rel=1e-11)
