"""Unicore's binary logs against RTKLIB demo5's decoder (pyrtklib5), which knows the main antenna's OBSVM and ephemerides, and zlib's CRC.

No recording of raw Unicore data is at hand: what is compared was encoded here, so this shows that two independent decoders read the same.
"""

import zlib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rtkmesh.codecs.framing import Framer
from rtkmesh.codecs.messages import Protocol
from rtkmesh.codecs.unicore import UnicoreDecoder
from rtkmesh.codecs.unicore_encode import binary_log, encode_ephemeris, encode_observations
from rtkmesh.codecs.unicore_signals import SATELLITES, SIGNALS
from rtkmesh.gnss.ephemeris import GlonassEphemeris, KeplerEphemeris
from rtkmesh.gnss.epoch import SLIP, Epoch, make_epoch
from rtkmesh.gnss.signals import SATELLITES_PER_SYSTEM, satellite_id, signal_code, signal_number
from rtkmesh.gnss.time import GpsTime
from rtkmesh.simulation.scenario import open_stream
from rtkmesh.simulation.sky import SATELLITES as SIMULATED
from rtkmesh.simulation.sky import broadcast

pyrtklib5: Any = pytest.importorskip("pyrtklib5", reason="pyrtklib5 has wheels for x86-64 only")

START = GpsTime(2419, 132572.0)
# Where RTKLIB's names of signals differ: B2b(I), the data channel, is 7D in RINEX 3.05; L6D and L6E of QZSS are 6S and 6E.
OTHER_CODES = {("C", "7D"): "7P", ("J", "6S"): "6Z"}


def new_raw() -> Any:
    raw = pyrtklib5.raw_t()
    assert pyrtklib5.init_raw(raw, pyrtklib5.STRFMT_UNICORE)
    return raw


def feed(raw: Any, data: bytes) -> int:
    """Return what RTKLIB says to the last byte."""
    result = 0
    for byte in data:
        result = pyrtklib5.input_unicore(raw, byte)
    return result


def ours(decoder: UnicoreDecoder, data: bytes) -> Any:
    (frame,) = Framer([Protocol.UNICORE]).feed(data)
    (message,) = decoder.decode(frame)
    return message


def theirs(raw: Any) -> dict[tuple[str, str], tuple[float, float, float, float, int]]:
    """Return pseudorange, phase, Doppler, C/N0 and slip by satellite and code."""
    rows: dict[tuple[str, str], tuple[float, float, float, float, int]] = {}
    for k in range(raw.obs.n):
        row = raw.obs.data[k]
        name = satellite_name(row.sat)
        for slot in range(len(row.code)):
            if row.code[slot]:
                code = pyrtklib5.code2obs(row.code[slot])
                rows[name, code] = row.P[slot], row.L[slot], row.D[slot], row.SNR[slot], row.LLI[slot] & 1
    return rows


def satellite_name(number: int) -> str:
    array = pyrtklib5.Arr1Dchar(8)
    pyrtklib5.satno2id(number, array)
    name = array[0]  # the string from there on
    return f"S{int(name) - 100:02d}" if name.isdecimal() else name


def test_simulated_epochs_are_read_alike():
    """Every value of every signal of a drive's epochs, with slips, as far as RTKLIB keeps them."""
    stream = open_stream("demo", "rover", seed=3, rate_hz=1.0, start=START)
    receiver, raw, decoder, compared, slips = stream.receiver(), new_raw(), UnicoreDecoder(), 0, 0
    for tag, _ in zip(stream.tags(), range(12), strict=False):
        epoch = receiver.observe(tag).epoch
        lost = np.arange(len(epoch)) % 7 == tag.tow_s % 7
        epoch = replace(epoch, lock_s=np.where(lost, 0.2, epoch.lock_s))
        data = encode_observations(epoch)
        assert feed(raw, data) == 1
        found, expected = ours(decoder, data), theirs(raw)
        assert isinstance(found, Epoch)
        rows = {(satellite, code): values for satellite, code, *values in found.rows()}
        assert set(expected) <= set(rows)
        assert {key[0][0] + key[1] for key in set(rows) - set(expected)} <= {"R2C"}  # it has no place for it in this build
        flags = {row[:2]: int(flag) for row, flag in zip(found.rows(), found.flags, strict=True)}
        for key, (code_m, phase_cyc, doppler_hz, cn0_dbhz, slip) in expected.items():
            sent = np.nan_to_num(np.array(rows[key]))
            assert sent[:2].tolist() == [code_m, phase_cyc]
            assert sent[2:].tolist() == pytest.approx([doppler_hz, cn0_dbhz], abs=2e-3)
            assert bool(flags[key] & SLIP) == bool(slip and phase_cyc)
            compared, slips = compared + 1, slips + slip
    assert compared > 600
    assert slips > 60


@pytest.mark.parametrize("number", sorted(SIGNALS))
def test_signals_have_rtklibs_names(number: int):
    """Each signal type of each system, one at a time: RTKLIB keeps some in the same place."""
    agreed = []
    for system_number, system, first, _, offset in SATELLITES:
        if system_number != number or (number == 5 and first == 1):  # RTKLIB wants the PRNs of QZSS
            continue
        satellite = system * SATELLITES_PER_SYSTEM + first - offset
        for code in SIGNALS[number].values():
            epoch = make_epoch(
                START, satellite=[satellite], signal=[signal_number(code)], channel=[0], pseudorange_m=[2e7], phase_cyc=[1e8]
            )
            data, raw = encode_observations(epoch), new_raw()
            feed(raw, data)
            found = ours(UnicoreDecoder(), data)
            names = [(satellite_id(int(s)), signal_code(int(c))) for s, c in zip(found.satellite, found.signal, strict=True)]
            assert names == [(satellite_id(satellite), code)]
            expected = list(theirs(raw))
            if expected:
                letter = satellite_id(satellite)[0]
                assert expected == [(satellite_id(satellite), OTHER_CODES.get((letter, code), code))]
                agreed.append(code)
    assert agreed or number in (2, 6), "SBAS and NavIC may not be compiled in"


def test_ephemerides_are_read_alike():
    """All values; RTKLIB takes the accuracy as metres, we as the variance that it is, and counts IODC as IODE."""
    systems = set()
    for satellite in SIMULATED.tolist():
        sent = broadcast(satellite, START)
        data, raw = encode_ephemeris(sent, START), new_raw()
        assert feed(raw, data) == 2
        found = ours(UnicoreDecoder(), data)
        assert satellite_name(raw.ephsat) == satellite_id(satellite)
        if isinstance(found, KeplerEphemeris):
            check_kepler(found, raw.nav.eph[raw.ephsat - 1])
        else:
            check_glonass(found, raw.nav.geph[satellite % SATELLITES_PER_SYSTEM - 1])
        systems.add(satellite // SATELLITES_PER_SYSTEM)
    assert systems == {0, 1, 2, 3}


def instant(time: Any) -> GpsTime:
    """Return a gtime_t, which counts GPS time from 1970."""
    return GpsTime.normalized(0, float(time.time - 315964800) + time.sec)


def check_kepler(found: KeplerEphemeris, e: Any) -> None:
    pairs = {
        "m0_rad": e.M0, "delta_n_radps": e.deln, "omega0_rad": e.OMG0, "omega_rad": e.omg, "omega_dot_radps": e.OMGd, "i0_rad": e.i0,
        "idot_radps": e.idot, "eccentricity": e.e, "cuc_rad": e.cuc, "cus_rad": e.cus, "crc_m": e.crc, "crs_m": e.crs, "cic_rad": e.cic,
        "cis_rad": e.cis, "af0_s": e.f0, "af1": e.f1, "af2": e.f2,
    }  # fmt: skip
    for name, value in pairs.items():
        assert getattr(found, name) == value, name
    assert found.sqrt_a**2 == pytest.approx(e.A, rel=1e-14)
    assert (instant(e.toe) - found.toe, instant(e.toc) - found.toc) == (0.0, 0.0)
    assert (found.iode, found.health) == (e.iode, e.svh)
    delays = (e.tgd[0], e.tgd[1] if found.satellite // SATELLITES_PER_SYSTEM in (2, 3) else 0.0)
    assert found.group_delay_s == delays


def check_glonass(found: GlonassEphemeris, e: Any) -> None:
    assert tuple(e.pos[k] for k in range(3)) == found.position_m
    assert tuple(e.vel[k] for k in range(3)) == found.velocity_mps
    assert tuple(e.acc[k] for k in range(3)) == found.acceleration_mps2
    assert (-e.taun + 0.0, e.gamn, e.dtaun) == (found.tau_s, found.gamma, found.group_delay_s)
    assert (e.frq, e.svh, e.iode) == (found.channel, found.health, found.iode)
    assert instant(e.toe) - found.toe == 0.0
    assert abs(instant(e.tof) - found.transmitted) < 1e-6


def test_the_receivers_week_is_ours():
    """Over the end of a week."""
    late, raw = GpsTime(2419, 604799.9), new_raw()
    epoch = make_epoch(late, satellite=[5], signal=[28], pseudorange_m=[2e7], phase_cyc=[1e8])
    feed(raw, encode_observations(epoch))
    assert instant(raw.obs.data[0].time) - late == pytest.approx(0.0, abs=1e-6)
    assert ours(UnicoreDecoder(), encode_observations(epoch)).time == late
    near = replace(broadcast(5, late), toe=GpsTime(2420, 0.0), toc=GpsTime(2420, 0.0))
    assert feed(raw, encode_ephemeris(near, late)) == 2
    found = ours(UnicoreDecoder(), encode_ephemeris(near, late))
    assert found.toe == instant(raw.nav.eph[raw.ephsat - 1].toe) == GpsTime(2420, 0.0)


def test_a_wrong_checksum_is_one_to_both():
    """CRC-32 with zlib's polynomial, initial value 0, no inversion at the end."""
    body = bytes(range(100))
    log = binary_log("GPSEPH", START, body)
    assert int.from_bytes(log[-4:], "little") == zlib.crc32(log[:-4], 0xFFFFFFFF) ^ 0xFFFFFFFF
    damaged = log[:40] + bytes([log[40] ^ 1]) + log[41:]
    assert feed(new_raw(), damaged) == -1
    assert Framer().feed(damaged) == []
