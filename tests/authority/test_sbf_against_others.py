"""SBF against others: what we encode as pysbf2, RTKLIB 2.4.3 (convbin) and RTKLIB demo5 (pyrtklib5) read it.

There is no recording in SBF among ours. The measurements are those of real mosaic receivers (RINEX of ``tokyo_static``) and simulated
ones; what the others make of the encoded stream must be what we make of it. convbin 2.4.3 b34 knows no QZSS, few BeiDou satellites,
no E5b beside E5a, no raw navigation of GPS and BeiDou, no options, takes "no phase" for a phase, and writes C/N0 in another unit.
demo5 knows all these; pyrtklib5 holds three signals of a satellite, one of each frequency.
"""

import subprocess
from collections.abc import Callable
from dataclasses import replace
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pysbf2 import SBFReader

from rtkmesh.codecs import sbf_encode as encode
from rtkmesh.codecs.rinex_navigation import read_navigation
from rtkmesh.codecs.rinex_observation import ObservationReader
from rtkmesh.codecs.sbf_signals import SATELLITE_OF
from rtkmesh.codecs.stream import StreamDecoder, StreamOptions
from rtkmesh.gnss.ephemeris import GlonassEphemeris, KeplerEphemeris
from rtkmesh.gnss.epoch import COLUMNS, Epoch, make_epoch
from rtkmesh.gnss.receiver_options import parse_receiver_options
from rtkmesh.gnss.signals import carrier_hz, satellite_id, signal_number
from rtkmesh.gnss.time import GpsTime
from rtkmesh.simulation.scenario import open_stream
from rtkmesh.simulation.sky import KLOBUCHAR, broadcast
from rtkmesh.simulation.ubx_stream import frame_start
from rtkmesh_services.cli.main import run as rtkmesh

# Fields of ours -> RTKLIB's.
KEPLER = {
    "m0_rad": "M0", "delta_n_radps": "deln", "omega0_rad": "OMG0", "omega_rad": "omg", "omega_dot_radps": "OMGd", "i0_rad": "i0",
    "idot_radps": "idot", "eccentricity": "e", "cuc_rad": "cuc", "cus_rad": "cus", "crc_m": "crc", "crs_m": "crs", "cic_rad": "cic",
    "cis_rad": "cis", "af0_s": "f0", "af1": "f1", "af2": "f2", "iode": "iode", "health": "svh",
}  # fmt: skip
Demo5 = Callable[..., tuple[list[Epoch], dict[int, Any]]]
START = GpsTime(2445, 532_800.0)
EPOCHS = 20
# By whether blocks are raw, and system: what convbin reads wrongly or RINEX 3.04 does not hold.
UNPRINTED = {"accuracy_m", "group_delay_s", "transmitted"}
WRONG_IN_CONVBIN = {
    True: {"R": UNPRINTED, "E": {"sqrt_a", "idot_radps", "crs_m", "af1", "af2", "accuracy_m", "transmitted"}},
    False: {"R": UNPRINTED, "E": {"message"}, "G": {"toe", "toc", "transmitted"}},
}
CONVBIN_CN0 = 250.0  # it writes C/N0 in the wrong unit
PRINTED = 6e-4  # RINEX has three decimals


def near_code(epochs: list[Epoch]) -> list[Epoch]:
    """Return the epochs with each signal's phase moved by whole cycles next to its code, as Septentrio receivers start it."""
    shift: dict[tuple[int, int], float] = {}
    moved: list[Epoch] = []
    for epoch in epochs:
        phase = epoch.phase_cyc.copy()
        for k, key in enumerate(zip(epoch.satellite.tolist(), epoch.signal.tolist(), strict=True)):
            code_cyc = epoch.pseudorange_m[k] * carrier_hz(*key, int(epoch.channel[k])) / 299_792_458.0
            if np.isfinite(phase[k] - code_cyc):
                phase[k] -= shift.setdefault(key, round(phase[k] - code_cyc))
        moved.append(replace(epoch, time=GpsTime(epoch.time.week, round(epoch.time.tow_s * 1e3) / 1e3), phase_cyc=phase))
    return moved


@pytest.fixture(scope="module")
def simulated() -> tuple[list[Epoch], bytes, bytes]:
    """Epochs of the demo's rover, their stream with raw navigation blocks, and one with decoded ones."""
    stream = open_stream("demo", "rover", seed=1, rate_hz=1.0, start=START)
    receiver = stream.receiver()
    epochs = near_code([receiver.observe(tag).epoch for tag in islice(stream.tags(), EPOCHS)])
    satellites = sorted({int(s) for epoch in epochs for s in epoch.satellite})
    raw = [part for s in satellites for part in encode.encode_navigation(broadcast(s, START), frame_start(s, START), KLOBUCHAR)]
    decoded = [encode.encode_ephemeris(broadcast(s, START), START) for s in satellites]
    measured = [encode.encode_meas_epoch(epoch) for epoch in epochs]
    return epochs, b"".join(measured[:1] + raw + measured[1:]), b"".join(measured[:1] + decoded + measured[1:])


def convbin(program: str, folder: Path, data: bytes, *options: str) -> tuple[list[Epoch], Path]:
    (folder / "log.sbf").write_bytes(data)
    command = [program, "-r", "sbf", "-v", "3.04", "-od", "-os", *options, "-o", "log.obs", "-n", "log.nav", "log.sbf"]
    subprocess.run(command, cwd=folder, check=True, capture_output=True, timeout=60)
    epochs = ObservationReader((folder / "log.obs").read_bytes())
    return [replace(epoch, cn0_dbhz=epoch.cn0_dbhz * CONVBIN_CN0) for epoch in epochs], folder / "log.nav"


def known_to(theirs: list[Epoch], ours: list[Epoch]) -> list[Epoch]:
    """Return our epochs with the satellites and signals only that theirs have (which must all be ours)."""
    return [a.take(np.isin(keys_of(a), keys_of(b))) for a, b in zip(ours, theirs, strict=True)]


def keys_of(epoch: Epoch) -> NDArray[np.int64]:
    return epoch.satellite.astype(np.int64) * 512 + epoch.signal


def with_second_signals(epoch: Epoch) -> Epoch:
    """Return the epoch with a further signal beside each one of GPS L2C and GLONASS L2 C/A: L2P, with other values."""
    rows = [k for k, (name, code, *_) in enumerate(epoch.rows()) if (name[0], code) in (("G", "2L"), ("R", "2C"))]
    also = [signal_number("2W" if epoch.satellite[k] < 64 else "2P") for k in rows]
    columns = {name: np.concatenate([getattr(epoch, name), getattr(epoch, name)[rows]]) for name, _, _ in COLUMNS}
    columns["signal"] = np.concatenate([epoch.signal, also])
    columns["pseudorange_m"][len(epoch) :] += 0.25
    return make_epoch(epoch.time, **columns)


def decoded(data: bytes, options: str = "") -> list[Epoch]:
    decoder = StreamDecoder(StreamOptions(receiver=parse_receiver_options(options)))
    found = [message for _, messages in decoder.feed(data) for message in messages] + decoder.flush()
    return [message for message in found if isinstance(message, Epoch)]


def assert_same(ours: list[Epoch], theirs: list[Epoch]) -> int:
    """Hold epochs against each other; return the number of equal rows."""
    assert [epoch.time for epoch in ours] == [epoch.time for epoch in theirs]
    for a, b in zip(ours, theirs, strict=True):
        assert [row[:2] for row in a.rows()] == [row[:2] for row in b.rows()]
        for name, most in (("pseudorange_m", PRINTED), ("phase_cyc", PRINTED), ("doppler_hz", 1.1e-3), ("cn0_dbhz", PRINTED)):
            np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=0.0, atol=most, err_msg=name)
    return sum(map(len, ours))


@pytest.mark.rtklib
def test_convbin_reads_the_measurements_as_we_do(
    simulated: tuple[list[Epoch], bytes, bytes], rtklib_program: Callable[[str], str], tmp_path: Path
):
    """Every epoch, satellite and signal of GPS, GLONASS, Galileo and BeiDou, value by value; and both are what was encoded."""
    epochs, data, _ = simulated
    ours = decoded(data)
    theirs, _ = convbin(rtklib_program("convbin"), tmp_path, data)
    assert assert_same(known_to(theirs, ours), theirs) > 1000
    for a, b in zip(ours, epochs, strict=True):
        np.testing.assert_allclose(a.pseudorange_m, b.pseudorange_m, rtol=0.0, atol=PRINTED)
        np.testing.assert_allclose(a.phase_cyc, b.phase_cyc, rtol=0.0, atol=PRINTED)


@pytest.mark.rtklib
def test_the_rinex_of_a_log_is_convbins(simulated: tuple[list[Epoch], bytes, bytes], rtklib_program: Callable[[str], str], tmp_path: Path):
    """``rtkmesh convert`` and convbin write the same observations, to the last digit that RINEX has."""
    theirs, _ = convbin(rtklib_program("convbin"), tmp_path, simulated[1])
    log, out = tmp_path / "log.sbf", tmp_path / "ours.obs"
    assert rtkmesh(["convert", str(log), "--to", "rinex", "--out", str(out), "--quiet"]) == 0
    ours = list(ObservationReader(out.read_bytes()))
    assert assert_same(known_to(theirs, ours), theirs) > 1000


@pytest.mark.rtklib
@pytest.mark.data
@pytest.mark.parametrize("name", ["rover.obs", "base.obs"])
def test_convbin_reads_what_mosaic_receivers_measured(data: Path, rtklib_program: Callable[[str], str], tmp_path: Path, name: str):
    """Real measurements of all systems with L1, L2P, L2C, L5, E1, E5a, E5b, B1I, B2I, B3I."""
    text = (data / "tokyo_static" / name).read_bytes()[:600_000]
    epochs = near_code(list(islice(ObservationReader(text), 20)))
    stream = b"".join(encode.encode_meas_epoch(epoch) for epoch in epochs)
    theirs, _ = convbin(rtklib_program("convbin"), tmp_path, stream)
    ours = known_to(theirs, decoded(stream))
    theirs = [replace(b, phase_cyc=np.where(np.isnan(a.phase_cyc), np.nan, b.phase_cyc)) for a, b in zip(ours, theirs, strict=True)]
    assert assert_same(ours, theirs) > 1000


@pytest.mark.data
@pytest.mark.parametrize("name", ["rover.obs", "base.obs"])
def test_demo5_reads_what_mosaic_receivers_measured(data: Path, demo5: Demo5, name: str):
    """The same with QZSS, E5b and most BeiDou satellites."""
    epochs = near_code(list(islice(ObservationReader((data / "tokyo_static" / name).read_bytes()[:200_000]), 8)))
    stream = b"".join(encode.encode_meas_epoch(epoch) for epoch in epochs)
    theirs, _ = demo5("sbf", stream, "-IHALFC")
    ours = known_to(theirs, decoded(stream)[:-1])
    assert assert_same(ours, theirs) > 500
    assert {satellite_id(int(satellite))[0] for satellite in ours[0].satellite} == set("GRECJ")


def ephemerides_of(data: bytes) -> dict[int, KeplerEphemeris | GlonassEphemeris]:
    found = [message for _, messages in StreamDecoder().feed(data) for message in messages]
    return {message.satellite: message for message in found if isinstance(message, KeplerEphemeris | GlonassEphemeris)}


@pytest.mark.parametrize("option", ["", "-AUX1", "-GL2L", "-RL2C"])
def test_demo5_reads_the_measurements_and_takes_options_as_we_do(simulated: tuple[list[Epoch], bytes, bytes], demo5: Demo5, option: str):
    """The auxiliary antenna (whose measurements are those of an earlier epoch here), and the only signal of a satellite's band."""
    epochs = [with_second_signals(epoch) for epoch in simulated[0]]
    stream = b"".join(encode.encode_meas_epoch(a, others=replace(b, time=a.time)) for a, b in zip(epochs[1:8], epochs, strict=False))
    theirs, _ = demo5("sbf", stream, f"-IHALFC {option}")
    ours = decoded(stream, option)[: len(theirs)]
    assert len(theirs) == 6
    assert assert_same(known_to(theirs, ours), theirs) > 200
    if "L" in option:
        wanted = option[1], option[3]
        for epochs_of in (ours, theirs):
            codes = {(name[0], code) for epoch in epochs_of for name, code, *_ in epoch.rows()}
            assert {code for system, code in codes if (system, code[0]) == wanted} == {option[3:]}


@pytest.mark.rtklib
@pytest.mark.parametrize("raw", [True, False])
def test_convbin_reads_the_navigation_blocks_as_we_do(
    simulated: tuple[list[Epoch], bytes, bytes], rtklib_program: Callable[[str], str], tmp_path: Path, raw: bool
):
    """GLORawCA and, but for the fields that end in the odd page, GALRawINAV; GPSNav, GALNav and GLONav: every ephemeris, value by value.

    convbin takes the last 16 bits of an I/NAV word from a wrong place, weeks of GPSNav for those before 2019, and all GALNav for F/NAV.
    """
    data, wrong = simulated[1 if raw else 2], WRONG_IN_CONVBIN[raw]
    ours = ephemerides_of(data)
    _, navigation = convbin(rtklib_program("convbin"), tmp_path, data)
    theirs = read_navigation(navigation.read_bytes()).ephemerides
    wanted = "ER" if raw else "GER"
    assert {e.satellite for e in theirs} >= {satellite for satellite in ours if satellite_id(satellite)[0] in wanted}
    for e in theirs:
        for name in set(e.__slots__) - wrong[satellite_id(e.satellite)[0]]:
            most = 1e-7 if name == "velocity_mps" else 1e-11  # single precision in GLONav
            assert numbers(getattr(ours[e.satellite], name)) == pytest.approx(numbers(getattr(e, name)), rel=most), name


def test_demo5_reads_the_raw_subframes_as_we_do(simulated: tuple[list[Epoch], bytes, bytes], demo5: Demo5):
    """GPSRawCA, BDSRaw and GALRawINAV (of which it wants word 6 before word 5): every satellite's ephemeris, value by value."""
    _, data, _ = simulated
    ours, (_, theirs) = ephemerides_of(data), demo5("sbf", data[:40_000] * 2)
    assert theirs.keys() == {satellite for satellite in ours if satellite_id(satellite)[0] in "GEC"}
    for satellite, e in theirs.items():
        mine = ours[satellite]
        for name, their_name in KEPLER.items():
            assert getattr(mine, name) == pytest.approx(getattr(e, their_name), rel=1e-12, abs=0.0), name


def numbers(value: object) -> list[float]:
    if isinstance(value, GpsTime):
        return [value.week * 604_800 + value.tow_s]
    return list(value) if isinstance(value, tuple) else [float(value)]  # pyright: ignore[reportArgumentType]


def parsed(data: bytes) -> list[Any]:
    return [message for _, message in SBFReader(BytesIO(data), quitonerror=2)]


def test_pysbf2_reads_the_measurements_as_we_do(simulated: tuple[list[Epoch], bytes, bytes]):
    """Code, Doppler and C/N0 of the first signal of each satellite, and the differences of the further ones."""
    _, data, _ = simulated
    ours = decoded(data)
    found = [message for message in parsed(data) if message.identity == "MeasEpoch"]
    assert len(found) == len(ours)
    for message, epoch in zip(found, ours, strict=True):
        assert (message.WNc, message.TOW) == (epoch.time.week, round(epoch.time.tow_s * 1e3))
        firsts = np.flatnonzero(np.diff(epoch.satellite, prepend=-1))
        assert len(firsts) == message.N1
        for k, row in enumerate(firsts, 1):
            code = getattr(message, f"CodeMSB_{k:02d}") + getattr(message, f"CodeLSB_{k:02d}")
            assert code == pytest.approx(epoch.pseudorange_m[row], abs=1e-6)
            assert getattr(message, f"Doppler_{k:02d}") == pytest.approx(epoch.doppler_hz[row], abs=1e-9)
            assert getattr(message, f"CN0_{k:02d}") + 10.0 == epoch.cn0_dbhz[row]
            assert getattr(message, f"HalfCycleAmbiguity_{k:02d}") == bool(epoch.flags[row] & 2)


def test_pysbf2_reads_the_ephemerides_as_we_do(simulated: tuple[list[Epoch], bytes, bytes]):
    """GPSNav, GALNav, GLONav and BDSNav field by field where their names tell the same."""
    _, _, data = simulated
    ours, seen = ephemerides_of(data), set[str]()
    for message in parsed(data):
        if not message.identity.endswith("Nav"):
            continue
        seen.add(message.identity)
        if message.identity == "GLONav":
            e = ours[int(SATELLITE_OF[message.SVID])]
            assert isinstance(e, GlonassEphemeris)
            assert (message.X, message.Dy, -message.tau) == pytest.approx((e.position_m[0], e.velocity_mps[1], e.tau_s))
            assert (message.FreqNr - 8, message.tb // 15, message.t_oe) == (e.channel, e.iode, e.toe.tow_s)
            continue
        svid = message.SVID if message.identity == "GALNav" else message.PRN
        e = ours[int(SATELLITE_OF[svid])]
        assert isinstance(e, KeplerEphemeris)
        assert (message.SQRT_A, message.e, message.C_uc, message.a_f0) == pytest.approx((e.sqrt_a, e.eccentricity, e.cuc_rad, e.af0_s))
        angles = (message.M_0, message.OMEGADOT, message.IDOT, message.DEL_N)
        assert [angle * np.pi for angle in angles] == pytest.approx([e.m0_rad, e.omega_dot_radps, e.idot_radps, e.delta_n_radps])
    assert seen == {"GPSNav", "GALNav", "GLONav", "BDSNav"}
