"""RTCM 3 decoding against pyrtcm, an independent decoder: the same frames, the same fields."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from pyrtcm import RTCMReader

from rtkmesh.codecs.framing import Framer
from rtkmesh.codecs.messages import Frame, Protocol
from rtkmesh.codecs.observation_rows import Rows
from rtkmesh.codecs.rtcm3 import MSM, Rtcm3Decoder
from rtkmesh.codecs.rtcm3_encode import encode_ephemeris, encode_epoch, encode_glonass_bias, encode_station, encode_station_message
from rtkmesh.codecs.rtcm3_ephemeris import LAYOUTS
from rtkmesh.codecs.rtcm3_legacy import NUMBERS as LEGACY
from rtkmesh.codecs.rtcm3_legacy import LegacyDecoder
from rtkmesh.codecs.rtcm3_msm import FIRST_SATELLITE, GROUP_OF_SYSTEM, MILLISECOND_M, SIGNAL_OF_BIT, SYSTEM_OF_GROUP, decode_msm
from rtkmesh.gnss.constants import SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.ephemeris import GlonassBias, KeplerEphemeris, NavigationMessage, ReferenceStation
from rtkmesh.gnss.epoch import HALF_CYCLE, Epoch, make_epoch
from rtkmesh.gnss.signals import NO_CHANNEL, SYSTEMS, carrier_hz, satellite_number, signal_code, signal_number
from rtkmesh.gnss.time import GpsTime

PER_KIND_AND_FILE = 2
LARGEST_FILE = 120_000  # bytes: pyrtcm reads 0.2 MB/s

MSM_FIELDS = {4: ("DF400", "DF401"), 5: ("DF400", "DF401"), 6: ("DF405", "DF406"), 7: ("DF405", "DF406")}
INVALID_MS = {"DF400": -(2.0**-10), "DF401": -(2.0**-8), "DF405": -(2.0**-10), "DF406": -(2.0**-8)}


def files(data: Path) -> list[Path]:
    return [path for path in sorted((data / "dec_rtcm3").iterdir()) if path.stat().st_size < LARGEST_FILE]


def frames_of(path: Path) -> list[Frame]:
    framer = Framer([Protocol.RTCM3])
    return framer.feed(path.read_bytes()) + framer.flush()


def sample(data: Path, numbers: frozenset[int]) -> list[Frame]:
    """Return the first frames of each kind in each file."""
    chosen: list[Frame] = []
    for path in files(data):
        seen = Counter[str]()
        for frame in frames_of(path):
            if int(frame.kind) in numbers and seen[frame.kind] < PER_KIND_AND_FILE:
                seen[frame.kind] += 1
                chosen.append(frame)
    return chosen


def finite(value: float, invalid: float) -> float:
    return float("nan") if value <= invalid else value


def msm_rows(number: int, fields: dict[str, float], channels: np.ndarray) -> list[tuple[int, int, float, float, float, float]]:
    """Return (satellite, signal, pseudorange, phase, Doppler, C/N0) of pyrtcm's fields."""
    system, level = SYSTEM_OF_GROUP[number // 10], number % 10
    position = {fields[f"PRN_{k:02d}"]: k for k in range(1, int(fields["NSat"]) + 1)}
    mask = int(fields["DF394"])
    numbers = [k for k in range(1, 65) if mask >> (64 - k) & 1]  # pyrtcm has no name for GLONASS 25 and above
    code, phase = MSM_FIELDS[level]
    rows: list[tuple[int, int, float, float, float, float]] = []
    for k in range(1, int(fields["NCell"]) + 1):
        prn = fields[f"CELLPRN_{k:02d}"]
        at = position[prn]
        satellite = numbers[at - 1] + FIRST_SATELLITE[system]
        whole = fields[f"DF397_{at:02d}"]
        rough = float("nan") if whole == 255 else whole + fields[f"DF398_{at:02d}"]
        signal = signal_number(str(fields[f"CELLSIG_{k:02d}"]))
        carrier = carrier_hz(system * 64 + satellite, signal, int(channels[satellite]) if system == 1 else NO_CHANNEL)
        wavelength = SPEED_OF_LIGHT_MPS / carrier if carrier else float("nan")
        rate = float("nan")
        if level in (5, 7):
            rate = finite(fields[f"DF399_{at:02d}"], -8192) + finite(fields[f"DF404_{k:02d}"], -1.6384)
        cn0 = fields[f"DF4{'03' if level < 6 else '08'}_{k:02d}"]
        rows.append((
            system * 64 + satellite, signal, (rough + finite(fields[f"{code}_{k:02d}"], INVALID_MS[code])) * MILLISECOND_M,
            (rough + finite(fields[f"{phase}_{k:02d}"], INVALID_MS[phase])) * MILLISECOND_M / wavelength,
            -rate / wavelength, cn0 or float("nan"),
        ))  # fmt: skip
    return rows


@pytest.mark.data
def test_all_frames_are_found(data: Path):
    """The frames by kind are those that pyrtcm's reader finds, in every small recording."""
    for path in files(data):
        if path.stat().st_size > 11_000:
            continue
        with path.open("rb") as stream:
            theirs = Counter(str(raw[3] << 4 | raw[4] >> 4) for raw, _ in RTCMReader(stream, quitonerror=0) if raw)
        ours = Counter(frame.kind for frame in frames_of(path))
        assert ours == theirs, path.name


@pytest.mark.data
def test_msm_values_equal(data: Path):
    """Pseudorange, phase, Doppler and C/N0 of every cell, of all systems and types that occur."""
    kinds, cells = set[str](), 0
    for frame in sample(data, MSM):
        parsed = vars(RTCMReader.parse(frame.data))
        channels = np.full(64, NO_CHANNEL, np.int8)
        rows = Rows()
        part, *_ = decode_msm(frame.data[3:-3], int(frame.kind), channels, rows)
        assert part is not None
        expected = [row for row in msm_rows(int(frame.kind), parsed, channels) if np.isfinite(row[2:5]).any()]
        assert [list(row[:2]) for row in expected] == rows.cells[: part.rows, :2].tolist()
        if expected:
            np.testing.assert_allclose(rows.values[: part.rows, :4], np.array([row[2:] for row in expected]), rtol=0.0, atol=2e-6)
        cells += len(expected)
        kinds.add(frame.kind)
    assert cells > 1000
    assert kinds >= {"1074", "1075", "1077", "1084", "1085", "1087", "1094", "1095", "1097", "1104", "1107", "1117", "1125", "1127"}


@pytest.mark.data
def test_legacy_values_equal(data: Path):
    """Pseudoranges and phases of 1004 and 1012 of a dozen makes of receiver."""
    kinds, signals = Counter[str](), Counter[str]()
    for frame in sample(data, frozenset(LEGACY)):
        parsed = vars(RTCMReader.parse(frame.data))
        rows = Rows()
        part = LegacyDecoder(np.full(64, NO_CHANNEL, np.int8)).decode(frame.data[3:-3], int(frame.kind), rows)
        assert part is not None
        cells, values = rows.cells[: part.rows], rows.values[: part.rows]
        glonass = frame.kind == "1012"
        names = (
            ("DF035", "DF041", "DF044", "DF042", "DF047", "DF048") if glonass else ("DF006", "DF011", "DF014", "DF012", "DF017", "DF018")
        )
        expected: list[tuple[float, float]] = []
        for k in range(1, int(parsed[names[0]]) + 1):
            whole, modulus, l1, code_l2, l2 = (float(parsed[f"{name}_{k:02d}"]) for name in names[1:])
            range_m = whole + modulus * MILLISECOND_M * (2.0 if glonass else 1.0)
            expected.append((range_m, range_m + finite(l1, -262.144)))
            if code_l2 > -163.84 or l2 > -262.144:
                expected.append((range_m + finite(code_l2, -163.84), range_m + finite(l2, -262.144)))
        carriers = [carrier_hz(int(s), int(g), int(c)) for s, g, c in cells[:, :3]]
        phase_m = values[:, 1] * SPEED_OF_LIGHT_MPS / np.array(carriers)
        np.testing.assert_allclose(np.column_stack((values[:, 0], phase_m)), expected, rtol=0.0, atol=1e-6)
        kinds[frame.kind] += 1
        signals.update(signal_code(int(signal)) for signal in cells[:, 1])
    assert min(kinds["1004"], kinds["1012"]) > 10
    assert set(signals) >= {"1C", "1P", "2P", "2D", "2W"}


EPHEMERIS_FIELDS = {
    1019: "week DF076 iode DF071 toe_s DF093 toc_s DF081 af0_s DF084 sqrt_a DF092 eccentricity DF090 crs_m DF086 tgd_s DF101 fit DF137",
    1020: "slot DF038 channel DF040 tk_hours DF107 position_x_m DF112 velocity_y_mps DF114 acceleration_z_mps2 DF119 nt_days DF129",
    1042: "week DF489 iode DF492 toe_s DF505 af2 DF494 af0_s DF496 sqrt_a DF504 crc_m DF510 health DF515",
    1044: "slot DF429 toc_s DF430 iode DF434 toe_s DF442 week DF452 health DF454 tgd_s DF455 iodc DF456 fit DF457",
    1045: "slot DF252 week DF289 iode DF290 toc_s DF293 af0_s DF296 toe_s DF304 bgd_e5a_s DF312 health_e5a DF314 invalid_e5a DF315",
    1046: "slot DF252 iode DF290 accuracy DF286 sqrt_a DF303 bgd_e5b_s DF313 health_e5b DF316 invalid_e1b DF288",
}
THEIR_UNITS = {"position_x_m": 1e3, "velocity_y_mps": 1e3, "acceleration_z_mps2": 1e3}


@pytest.mark.data
def test_ephemeris_fields_equal(data: Path):
    """Fields at both ends and in the middle of each ephemeris message, so that the whole layout stands where it should."""
    checked = Counter[int]()
    for frame in sample(data, frozenset(LAYOUTS)):
        number, parsed = int(frame.kind), vars(RTCMReader.parse(frame.data))
        layout, payload = LAYOUTS[number], frame.data[3:-3]
        values = layout.read(int.from_bytes(payload, "big") >> (8 * len(payload) - layout.bits))
        names = EPHEMERIS_FIELDS[number].split()
        for ours, theirs in zip(names[::2], names[1::2], strict=True):
            expected = parsed[theirs] >> 7 if theirs == "DF107" else parsed[theirs] * THEIR_UNITS.get(ours, 1.0)
            assert values[ours] == pytest.approx(expected, rel=1e-12), (number, ours)
        checked[number] += 1
    assert set(checked) == set(LAYOUTS) - {1041}  # no recording has it: see below


def test_an_encoded_station_reads_the_same():
    """pyrtcm reads back the position, height and texts of our 1006 and 1033."""
    where = (3774089.2120, -601661.6157, 5089321.2474)
    station = ReferenceStation(1234, where, 1.2345, "LEIAR25.R3      NONE", "09330026", "RECEIVER X")
    position, descriptors = (vars(RTCMReader.parse(data)) for data in encode_station(station))
    assert [position["DF003"], descriptors["DF003"]] == [1234, 1234]
    assert [position[name] for name in ("DF025", "DF026", "DF027", "DF028")] == pytest.approx([*where, 1.2345], abs=1e-9)
    assert "".join(descriptors[f"DF030_{k:02d}"] for k in range(1, 21)) == station.antenna


@pytest.mark.data
def test_every_frame_of_every_file_is_understood_or_known(data: Path):
    """Nothing of all recordings is rejected but cells without a known channel, redundant legacy messages and days that are not known."""
    for path in sorted((data / "dec_rtcm3").iterdir()):
        decoder = Rtcm3Decoder(GpsTime.from_calendar(2018, 7, 14, 12))
        for frame in frames_of(path):
            decoder.decode(frame)
        decoder.flush()
        allowed = ("unknown frequency channel", "redundant beside MSM", "1012 epoch time", "1084 epoch time")
        assert [reason for reason in decoder.counters.rejected if not reason.endswith(allowed)] == [], path.name


def test_first_satellites_follow_the_masks():
    """SBAS PRN 120 is RINEX S20, QZSS 193 is J01."""
    assert FIRST_SATELLITE[5] + 1 == 20
    assert FIRST_SATELLITE[4] + 1 == 1


CODES = {"G": "1C 2L 2W 5Q", "R": "1C 2C", "E": "1C 5Q 7Q", "C": "2I 6I 7I", "J": "1C 2L 5Q"}  # all signals are in the decoder's test


def an_epoch(letter: str) -> Epoch:
    """Five satellites of one system with all signals, values of their own in each field."""
    rows = [(satellite_number(f"{letter}{k:02d}"), signal_number(code)) for k in (1, 2, 4, 7, 9) for code in CODES[letter].split()]
    satellite, signal = (np.array(column) for column in zip(*rows, strict=True))
    channel, k = np.where(satellite // 64 == 1, satellite % 13 - 7, NO_CHANNEL), np.arange(len(rows))
    carrier = np.array([carrier_hz(*one) for one in zip(satellite.tolist(), signal.tolist(), channel.tolist(), strict=True)])
    range_m = 2.1e7 + 1.234e5 * (satellite % 64) + 3.3 * k
    return make_epoch(
        GpsTime(2400, 345600.2), satellite=satellite, signal=signal, channel=channel, pseudorange_m=range_m, flags=k % 2 * HALF_CYCLE,
        phase_cyc=(range_m + 7.7 - k) * carrier / SPEED_OF_LIGHT_MPS,
        doppler_hz=-(100.0 * (satellite % 7) + 0.01 * k) * carrier / SPEED_OF_LIGHT_MPS, cn0_dbhz=30.0 + k, lock_s=1.0 + 10.0 * k,
    )  # fmt: skip


@pytest.mark.parametrize("level", [4, 5, 7])
@pytest.mark.parametrize("letter", list(CODES))
def test_an_encoded_epoch_reads_the_same(letter: str, level: int):
    """pyrtcm reads satellites, signals, ranges, phases, rates, strengths and half cycles of our MSM4, MSM5 and MSM7, cell by cell."""
    epoch, system = an_epoch(letter), SYSTEMS.index(letter)
    [data] = encode_epoch(epoch, 1234, level)
    fields = vars(RTCMReader.parse(data))
    assert (int(fields["DF002"]), fields["DF003"]) == (10 * GROUP_OF_SYSTEM[system] + level, 1234)
    channels = np.full(64, NO_CHANNEL, np.int8)
    channels[epoch.satellite % 64] = epoch.channel
    rows = msm_rows(int(fields["DF002"]), fields, channels)
    order = np.lexsort(([bit_of(system, int(signal)) for signal in epoch.signal], epoch.satellite))
    assert [row[:2] for row in rows] == [(int(epoch.satellite[k]), int(epoch.signal[k])) for k in order]
    code_ms, phase_ms, cn0 = {4: (2.0**-24, 2.0**-29, 1.0), 5: (2.0**-24, 2.0**-29, 1.0), 7: (2.0**-29, 2.0**-31, 2.0**-4)}[level]
    for number, (row, k) in enumerate(zip(rows, order, strict=True), 1):
        wavelength_m = SPEED_OF_LIGHT_MPS / carrier_hz(int(epoch.satellite[k]), int(epoch.signal[k]), int(epoch.channel[k]))
        assert abs(row[2] - epoch.pseudorange_m[k]) <= 0.51 * code_ms * MILLISECOND_M
        assert abs(row[3] - epoch.phase_cyc[k]) * wavelength_m <= 0.51 * phase_ms * MILLISECOND_M
        if level != 4:
            assert abs(row[4] - epoch.doppler_hz[k]) * wavelength_m <= 0.51e-4
        assert abs(row[5] - epoch.cn0_dbhz[k]) <= 0.51 * cn0
        assert fields[f"DF420_{number:02d}"] == (epoch.flags[k] & HALF_CYCLE) // HALF_CYCLE


def bit_of(system: int, signal: int) -> int:
    return int(np.flatnonzero(SIGNAL_OF_BIT[system] == signal)[0])


def test_encoded_station_messages_read_the_same():
    """1005, 1007, 1008 and 1230."""
    where = (3774089.2120, -601661.6157, 5089321.2474)
    station = ReferenceStation(1234, where, 1.2345, "LEIAR25.R3      NONE", "09330026", "RECEIVER X")
    position, antenna, serial = (vars(RTCMReader.parse(encode_station_message(station, number))) for number in (1005, 1007, 1008))
    assert [position[name] for name in ("DF025", "DF026", "DF027")] == pytest.approx(where, abs=1e-9)
    assert (text_of(antenna, "DF030"), text_of(serial, "DF030"), text_of(serial, "DF033")) == (station.antenna, station.antenna, "09330026")
    bias = vars(RTCMReader.parse(encode_glonass_bias(GlonassBias(1234, True, (1.5, float("nan"), -2.24, float("nan"))))))
    assert (bias["DF421"], bias["DF422_1"], bias["DF422_2"], bias["DF422_3"], bias["DF422_4"]) == (1, 1, 0, 1, 0)
    assert (bias["DF423"], bias["DF425"]) == pytest.approx((1.5, -2.24))
    with pytest.raises(ValueError, match="1013"):
        encode_station_message(station, 1013)


def text_of(fields: dict[str, object], name: str) -> str:
    return "".join(str(fields[key]) for key in sorted(fields) if key.startswith(name))


def test_an_encoded_navic_ephemeris_reads_the_same():
    """1041: every field, whose order and scale no recording shows."""
    toe = GpsTime(2400, 345600.0)
    sent = KeplerEphemeris(
        satellite=satellite_number("I05"), message=NavigationMessage.LNAV, iode=33, iodc=33, toe=toe, toc=toe + -16.0, transmitted=toe,
        health=2, accuracy_m=4.0, fit_s=7200.0, sqrt_a=6493.25, eccentricity=0.002, m0_rad=1.0, delta_n_radps=4e-9, omega0_rad=2.0,
        omega_rad=-1.0, omega_dot_radps=-8e-9, i0_rad=0.5, idot_radps=1e-10, cuc_rad=1e-6, cus_rad=2e-6, crc_m=100.0, crs_m=-50.0,
        cic_rad=1e-7, cis_rad=-1e-7, af0_s=1e-4, af1=1e-11, af2=0.0, group_delay_s=(-(2.0**-30), 0.0),
    )  # fmt: skip
    fields = vars(RTCMReader.parse(encode_ephemeris(sent)))
    names = {
        "DF516": 5, "DF517": 2400 % 1024, "DF518": sent.af0_s, "DF519": sent.af1, "DF522": 345584.0, "DF523": -(2.0**-30), "DF524": 4e-9,
        "DF525": 33, "DF527": 1, "DF528": 0, "DF529": 1e-6, "DF530": 2e-6, "DF531": 1e-7, "DF532": -1e-7, "DF533": 100.0, "DF534": -50.0,
        "DF535": 1e-10, "DF536": 1.0, "DF537": 345600.0, "DF538": 0.002, "DF539": 6493.25, "DF540": 2.0, "DF541": -1.0, "DF542": -8e-9,
        "DF543": 0.5,
    }  # fmt: skip
    angles = {"DF524", "DF535", "DF536", "DF540", "DF541", "DF542", "DF543"}  # semicircles
    for name, value in names.items():
        assert fields[name] * (np.pi if name in angles else 1.0) == pytest.approx(value, rel=2e-2, abs=1e-14), name
