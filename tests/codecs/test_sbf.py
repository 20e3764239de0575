"""SBF blocks: what each field of the measurements means, navigation data, the receiver's own solution, and damaged blocks."""

import struct
from dataclasses import replace
from math import nan, radians

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtkmesh.codecs import sbf_encode as encode
from rtkmesh.codecs.framing import Framer
from rtkmesh.codecs.messages import Message
from rtkmesh.codecs.sbf import SbfDecoder
from rtkmesh.codecs.sbf_signals import SATELLITE_OF, septentrio_signal
from rtkmesh.codecs.stream import StreamDecoder, StreamOptions
from rtkmesh.gnss.ephemeris import GlonassEphemeris, KeplerEphemeris, KlobucharParameters, NavigationMessage, ReceiverFix, ReferenceStation
from rtkmesh.gnss.epoch import HALF_CYCLE, SLIP, Epoch, make_epoch
from rtkmesh.gnss.frames import ecef_from_geodetic
from rtkmesh.gnss.receiver import CarrierSolution, ReceiverHeading
from rtkmesh.gnss.receiver_options import ReceiverOptions
from rtkmesh.gnss.signals import NO_CHANNEL, carrier_hz, satellite_id, satellite_number, signal_number
from rtkmesh.gnss.time import GpsTime
from rtkmesh.simulation.sky import KLOBUCHAR, SATELLITES, broadcast
from rtkmesh.simulation.ubx_stream import frame_start

TIME = GpsTime(2350, 302_400.2)


def decode(data: bytes, decoder: SbfDecoder | None = None) -> list[Message]:
    decoder = decoder or SbfDecoder()
    frames = Framer().feed(data)
    assert sum(len(frame.data) for frame in frames) == len(data)
    return [message for frame in frames for message in decoder.decode(frame)]


def epoch_of(messages: list[Message]) -> Epoch:
    (epoch,) = [message for message in messages if isinstance(message, Epoch)]
    return epoch


def an_epoch(names: list[tuple[str, str]], time: GpsTime = TIME, **columns: object) -> Epoch:
    """Return an epoch whose codes and phases are near each other, as the block needs it."""
    satellite = [satellite_number(name) for name, _ in names]
    signal = [signal_number(code) for _, code in names]
    channel = [3 if name[0] == "R" else NO_CHANNEL for name, _ in names]
    code = [2.2e7 + 1e5 * s + 1.234 * k for k, s in enumerate(satellite)]
    phase = [p * carrier_hz(s, g, c) / 299_792_458.0 - 700.5 for p, s, g, c in zip(code, satellite, signal, channel, strict=True)]
    doppler = [-7.8e-7 * carrier_hz(*signal) + k for k, signal in enumerate(zip(satellite, signal, channel, strict=True))]
    values = {
        "satellite": satellite, "signal": signal, "channel": channel, "pseudorange_m": code, "phase_cyc": phase, "doppler_hz": doppler,
        "cn0_dbhz": [44.25] * len(names), "lock_s": [77.0] * len(names), **columns,
    }  # fmt: skip
    return make_epoch(time, **values)


ALL = [
    ("G05", "1C"), ("G05", "1W"), ("G05", "2W"), ("G05", "2L"), ("G05", "5Q"), ("G05", "1L"), ("R07", "1C"), ("R07", "1P"), ("R07", "2P"),
    ("R07", "2C"), ("R07", "3Q"), ("R24", "1C"), ("R25", "1C"), ("E36", "1C"), ("E36", "6C"), ("E36", "5Q"), ("E36", "7Q"), ("E36", "8Q"),
    ("C01", "2I"), ("C40", "7I"), ("C41", "6I"), ("C63", "1P"), ("C63", "5P"), ("C63", "7D"), ("J01", "1C"), ("J01", "2L"), ("J07", "5Q"),
    ("J02", "1L"), ("J02", "1Z"), ("S20", "1C"), ("S41", "5I"), ("I01", "5A"), ("I14", "5A"),
]  # fmt: skip


def test_every_signal_comes_back_with_its_values():
    """All of Septentrio's signals that have a RINEX code: satellites, codes, values to the resolution of the block."""
    sent = an_epoch(ALL)
    found = epoch_of(decode(encode.encode_meas_epoch(sent)))
    assert found.time == sent.time
    assert [row[:2] for row in found.rows()] == [row[:2] for row in sent.rows()]
    np.testing.assert_allclose(found.pseudorange_m, sent.pseudorange_m, atol=5.1e-4)
    np.testing.assert_allclose(found.phase_cyc, sent.phase_cyc, atol=5.1e-4)
    np.testing.assert_allclose(found.doppler_hz, sent.doppler_hz, atol=1.1e-4)
    np.testing.assert_array_equal(found.cn0_dbhz, sent.cn0_dbhz)
    np.testing.assert_array_equal(found.lock_s, sent.lock_s)
    assert found.channel[found.satellite // 64 == 1].tolist() == [3] * 7


def test_e6_is_b_where_the_block_says_so():
    """CommonFlags bit 6."""
    assert [row[1] for row in epoch_of(decode(encode.encode_meas_epoch(an_epoch([("E05", "1C"), ("E05", "6B")])))).rows()] == ["1C", "6B"]


def test_what_was_not_measured_is_not_there():
    """No phase, no Doppler, no C/N0 of a first signal; no code of a second one takes its phase along."""
    sent = an_epoch(
        [("G01", "1C"), ("G02", "1C"), ("G02", "2L"), ("G03", "1C"), ("G03", "2L")],
        phase_cyc=[nan, 1.2e8, nan, 1.2e8, 1.2e8], doppler_hz=[1.0, nan, 2.0, 3.0, nan], cn0_dbhz=[nan, 40.0, nan, 41.0, 42.0],
        pseudorange_m=[2.2e7, 2.2e7, 2.2e7, 2.2e7, nan],
    )  # fmt: skip
    sent = replace(sent, phase_cyc=np.where(np.isnan(sent.phase_cyc), np.nan, 2.2e7 * 1575.42e6 / 299_792_458.0))
    found = epoch_of(decode(encode.encode_meas_epoch(sent)))
    assert np.isnan(found.phase_cyc).tolist() == [True, False, True, False, True]
    assert np.isnan(found.doppler_hz).tolist() == [False, True, True, False, True]
    assert np.isnan(found.cn0_dbhz).tolist() == [True, False, True, False, False]
    assert np.isnan(found.pseudorange_m).tolist() == [False, False, False, False, True]


def test_the_antenna_can_be_chosen():
    """Measurements of the auxiliary antenna come in the same block; each decoder takes those of one."""
    main, other = an_epoch([("G05", "1C"), ("G05", "2L")]), an_epoch([("G05", "1C"), ("G07", "1C")])
    data = encode.encode_meas_epoch(main, others=other)
    names = [[row[:2] for row in epoch_of(decode(data, SbfDecoder(antenna=antenna))).rows()] for antenna in (0, 1, 2)]
    assert names == [[("G05", "1C"), ("G05", "2L")], [("G05", "1C"), ("G07", "1C")], []]
    stream = StreamDecoder(StreamOptions(receiver=ReceiverOptions(antenna=1)))
    assert [row[0] for row in epoch_of(stream.feed(data)[0][1]).rows()] == ["G05", "G07"]


@pytest.mark.parametrize(
    ("locks", "seconds", "slips"),
    [
        ((10, 11), 1.0, [False, False]),
        ((10, 10), 1.0, [False, False]),  # whole seconds
        ((10, 9), 1.0, [False, True]),
        ((10, 28), 30.0, [False, True]),  # it grew, but not by the time that passed
        ((10, 39), 30.0, [False, False]),
        ((0, 0), 0.1, [True, True]),  # nobody can tell
        ((400, 500), 100.0, [False, False]),  # a second signal counts to 254 s
    ],
)
def test_slips_show_in_the_lock_time(locks: tuple[int, int], seconds: float, slips: list[bool]):
    """Both signals of a satellite: the first one's lock time has two bytes, the second one's has one."""
    decoder, found = SbfDecoder(), list[list[bool]]()
    for k, lock in enumerate(locks):
        epoch = an_epoch([("G05", "1C"), ("G05", "2L")], TIME + k * seconds, lock_s=[float(lock)] * 2)
        found.append(((epoch_of(decode(encode.encode_meas_epoch(epoch), decoder)).flags & SLIP) > 0).tolist())
    assert found == [[slip, slip] for slip in slips]


def test_a_signal_that_becomes_the_second_one_has_not_slipped():
    """Its lock time of 1000 s is then sent as 254 s."""
    decoder = SbfDecoder()
    decode(encode.encode_meas_epoch(an_epoch([("G05", "2L")], lock_s=[1000.0])), decoder)
    both = an_epoch([("G05", "1C"), ("G05", "2L")], TIME + 1.0, lock_s=[5.0, 1001.0])
    found = epoch_of(decode(encode.encode_meas_epoch(both), decoder))
    assert found.lock_s.tolist() == [5.0, 254.0]
    assert (found.flags & SLIP).tolist() == [0, 0]


def test_half_cycles_and_clock_jumps_are_told():
    decoder = SbfDecoder()
    epoch = an_epoch([("G05", "1C"), ("G05", "2L")], flags=[HALF_CYCLE, 0])
    assert (epoch_of(decode(encode.encode_meas_epoch(epoch), decoder)).flags & HALF_CYCLE).tolist() == [HALF_CYCLE, 0]
    decode(encode.encode_meas_epoch(replace(epoch, time=TIME + 1.0), clock_jumps=1), decoder)
    assert decoder.clock_resets == 1


def test_extra_blocks_bring_sigmas_and_fine_c_n0():
    """The first epoch leaves before its MeasExtra, the others with it; without one they leave with the next block."""
    columns = {"pseudorange_sigma_m": [0.25, 0.5], "phase_sigma_cyc": [0.004, 0.01], "cn0_dbhz": [44.34375, 40.0]}
    epochs = [an_epoch([("G05", "1C"), ("J02", "1L")], TIME + k, **columns) for k in range(4)]
    decoder = SbfDecoder()
    data = [encode.encode_meas_epoch(epoch) + encode.encode_meas_extra(epoch) for epoch in epochs[:2]]
    data += [encode.encode_meas_epoch(epochs[2]), encode.encode_meas_epoch(epochs[3])]
    first, second, third, fourth = (decode(part, decoder) for part in data)
    assert np.isnan(epoch_of(first).pseudorange_sigma_m).all()
    found = epoch_of(second)
    np.testing.assert_allclose(found.pseudorange_sigma_m, [0.25, 0.5])
    np.testing.assert_allclose(found.phase_sigma_cyc, [0.004, 0.01])
    np.testing.assert_allclose(found.cn0_dbhz, [44.34375, 40.0])
    assert (third, len(fourth)) == ([], 2)  # as soon as it is seen that none comes, epochs leave at once
    assert decoder.flush() == []


def test_scrambled_and_timeless_measurements_are_refused():
    """CommonFlags bit 7: no permission for measurements. Without a time there is no epoch."""
    decoder, whole = SbfDecoder(), encode.encode_meas_epoch(an_epoch(ALL))
    scrambled = bytearray(whole[14:])
    scrambled[3] |= 0x80
    for data in (encode.block("4027", TIME, bytes(scrambled)), encode.block("4027", None, whole[14:])):
        assert decode(data, decoder) == []
    assert decoder.counters.rejected == {"sbf/4027 scrambled": 1, "sbf/4027 time": 1}


def test_numbers_without_a_satellite_are_none():
    """SVID 62 is a GLONASS satellite whose slot is not known; signals belong to a system."""
    assert [satellite_id(int(SATELLITE_OF[svid])) for svid in (1, 37, 38, 61, 63, 71, 120, 141, 181, 191, 198, 223)] == [
        "G01", "G37", "R01", "R24", "R25", "E01", "S20", "C01", "J01", "I01", "S41", "C41",
    ]  # fmt: skip
    assert not any(SATELLITE_OF[svid] for svid in (0, 62, 69, 70, 107, 119, 188, 190, 246, 255))
    assert septentrio_signal(satellite_number("G05"), signal_number("2X")) is None
    assert septentrio_signal(satellite_number("E05"), signal_number("6B")) == 19


def ephemerides_of(data: bytes) -> dict[int, KeplerEphemeris | GlonassEphemeris]:
    found = [message for _, messages in StreamDecoder().feed(data) for message in messages]
    return {message.satellite: message for message in found if isinstance(message, KeplerEphemeris | GlonassEphemeris)}


def test_raw_and_decoded_blocks_give_the_same_ephemerides():
    """LNAV, I/NAV, D1 and GLONASS strings against GPSNav, GALNav, BDSNav, GLONav and QZSNav of the same satellites."""
    now = GpsTime(2445, 532_800.0)
    sent = [broadcast(satellite, now) for satellite in SATELLITES[::3]]
    sent.append(replace(next(e for e in sent if satellite_id(e.satellite)[0] == "G"), satellite=satellite_number("J02"), fit_s=7200.0))
    raw = ephemerides_of(b"".join(part for e in sent for part in encode.encode_navigation(e, frame_start(e.satellite, now), KLOBUCHAR)))
    decoded = ephemerides_of(b"".join(encode.encode_ephemeris(e, now) for e in raw.values()))
    assert raw.keys() == decoded.keys() == {e.satellite for e in sent}
    for e in sent:
        for name in set(e.__slots__) - {"transmitted"}:
            of_raw, of_decoded = (numbers(getattr(found[e.satellite], name)) for found in (raw, decoded))
            assert of_raw == pytest.approx(of_decoded, rel=1e-12), name


def numbers(value: object) -> list[float]:
    if isinstance(value, GpsTime):
        return [float(value.week), value.tow_s]
    return list(value) if isinstance(value, tuple) else [float(str(int(value) if isinstance(value, NavigationMessage) else value))]


def test_ionosphere_comes_from_its_own_blocks_and_from_beidou_subframes():
    """GPSIon, BDSIon."""
    for system in "GC":
        parameters = replace(KLOBUCHAR, system=system)
        (found,) = decode(encode.encode_ionosphere(parameters, TIME))
        assert isinstance(found, KlobucharParameters)
        np.testing.assert_allclose((*found.alpha, *found.beta), (*parameters.alpha, *parameters.beta), rtol=1e-7)


def test_galileo_ephemerides_of_f_nav_keep_their_health():
    """GALNav with source 16: signal health of E5a, one group delay."""
    e = next(e for s in SATELLITES if isinstance(e := broadcast(s, TIME), KeplerEphemeris) and e.message is NavigationMessage.INAV)
    sent = replace(e, message=NavigationMessage.FNAV, health=0b11 << 4 | 1 << 3, group_delay_s=(e.group_delay_s[0], 0.0))
    (found,) = decode(encode.encode_ephemeris(sent, TIME))
    assert isinstance(found, KeplerEphemeris)
    assert (found.message, found.health, found.accuracy_m) == (NavigationMessage.FNAV, sent.health, sent.accuracy_m)
    assert found.group_delay_s == pytest.approx(sent.group_delay_s, rel=1e-6)


@pytest.mark.parametrize("kind", [0, 2, 3, 4, 5, 6])
def test_the_fix_of_a_pvt_comes_back(kind: int):
    """Position, velocity, accuracies (sent as two sigma, in centimetres), satellites."""
    sent = ReceiverFix(TIME, kind, 0.9, -0.2, 123.4, 0.015, 0.02, (1.0, -2.0, 0.5), 17)
    (found,) = decode(encode.encode_pvt(sent))
    assert found == sent


def test_a_base_station_says_its_place_and_names():
    """ReceiverSetup and PVTGeodetic of a fixed location; what repeats says nothing."""
    station = ReferenceStation(0, antenna="SEPPOLANT_X_MF", antenna_serial="77", receiver="MOSAIC-X5 4.14.10", source="sbf")
    fix = ReceiverFix(TIME, 3, radians(52.0), radians(13.0), 80.0, 0.01, 0.01, None, 20)
    decoder = SbfDecoder()
    setup, place = encode.encode_setup(station, TIME), encode.encode_pvt(fix, fixed_location=True)
    assert decode(setup + setup, decoder) == [station]
    moved, _, again = decode(place + place, decoder)
    assert isinstance(moved, ReferenceStation)
    assert isinstance(again, ReceiverFix)
    assert moved.antenna == station.antenna
    assert moved.position_ecef_m == pytest.approx(ecef_from_geodetic(fix.lat_rad, fix.lon_rad, fix.height_m).tolist(), abs=1e-4)
    assert decode(encode.encode_pvt(fix), SbfDecoder()) == [fix]  # a rover has no place of its own


def test_a_marker_below_the_antenna_is_not_the_antenna():
    """The offset of ReceiverSetup is added where the block says that marker and antenna are two points."""
    fix = ReceiverFix(TIME, 3, radians(52.0), radians(13.0), 80.0, 0.01, 0.01, None, 20)
    place = bytearray(encode.encode_pvt(fix, fixed_location=True)[14:])
    place[80] = 2 << 6
    data = encode.encode_setup(ReferenceStation(0, antenna_height_m=1.5), TIME) + encode.block("4007", TIME, bytes(place), 2)
    (_, station, _) = decode(data)
    assert isinstance(station, ReferenceStation)
    assert station.position_ecef_m == pytest.approx(ecef_from_geodetic(fix.lat_rad, fix.lon_rad, 81.5).tolist(), abs=1e-4)


HEADING = ReceiverHeading(
    TIME, "AttEuler", CarrierSolution.FIXED, of_baseline=False, heading_rad=4.5, heading_sigma_rad=0.002, pitch_rad=0.1,
    pitch_sigma_rad=0.004, satellites=14, baseline_ned_m=(1.0, -0.5, 0.1), length_m=1.1224972160321824,
)  # fmt: skip


def close(found: Message, sent: ReceiverHeading) -> bool:
    assert isinstance(found, ReceiverHeading)
    names = ("heading_rad", "heading_sigma_rad", "pitch_rad", "pitch_sigma_rad", "roll_rad", "roll_sigma_rad", "length_m")
    same = (found.time, found.source, found.solution, found.of_baseline, found.satellites, found.baseline_ned_m)
    np.testing.assert_allclose([getattr(found, n) for n in names], [getattr(sent, n) for n in names], rtol=1e-6)
    return same == (sent.time, sent.source, sent.solution, sent.of_baseline, sent.satellites, sent.baseline_ned_m)


def test_a_heading_comes_with_its_sigmas_and_baseline():
    """The first one leaves at once; then the decoder knows what to wait for. Without EndOfAtt they leave with the last block."""
    decoder = SbfDecoder()
    sent = [replace(HEADING, time=TIME + k) for k in range(3)]
    (first,) = decode(encode.encode_attitude(sent[0]), decoder)
    assert close(first, replace(sent[0], heading_sigma_rad=nan, pitch_sigma_rad=nan, baseline_ned_m=None, length_m=nan))
    (second,) = decode(encode.encode_attitude(sent[1]), decoder)
    assert close(second, sent[1])
    (third,) = decode(encode.encode_attitude(sent[2])[:-16], decoder)
    assert close(third, sent[2])


def test_a_heading_does_not_wait_for_what_no_longer_comes():
    """AttCovEuler is switched off: one heading leaves with the next block, the others at once."""
    decoder = SbfDecoder()
    for k in range(2):
        decode(encode.encode_attitude(replace(HEADING, time=TIME + k)), decoder)
    alone = [encode.encode_attitude(replace(HEADING, time=TIME + 2 + k))[:44] for k in range(3)]
    assert [len(decode(data, decoder)) for data in alone] == [0, 2, 1]


@pytest.mark.parametrize("change", [{"solution": CarrierSolution.NONE}, {"heading_rad": nan}])
def test_a_heading_that_is_not_valid_is_none(change: dict[str, object]):
    (found,) = decode(encode.encode_attitude(replace(HEADING, **change))[:44])
    assert isinstance(found, ReceiverHeading)
    assert not found.valid


BLOCKS = [
    encode.encode_meas_epoch(an_epoch(ALL)),
    encode.encode_meas_extra(an_epoch(ALL)),
    *(encode.encode_ephemeris(broadcast(s, TIME), TIME) for s in SATELLITES[::6]),
    *(part for s in SATELLITES[::6] for part in encode.encode_navigation(broadcast(s, TIME), frame_start(s, TIME))[:1]),
    encode.encode_ionosphere(KLOBUCHAR, TIME),
    encode.encode_pvt(ReceiverFix(TIME, 3, 0.9, -0.2, 123.4, 0.015, 0.02, None, 17)),
    encode.encode_setup(ReferenceStation(0), TIME),
]


@pytest.mark.parametrize("whole", BLOCKS, ids=lambda data: str(int.from_bytes(data[4:6], "little") & 0x1FFF))
def test_blocks_that_are_too_short_are_refused(whole: bytes):
    """Every length from the header on; only padding may be missing, and what later revisions of PVTGeodetic added."""
    kind = str(int.from_bytes(whole[4:6], "little") & 0x1FFF)
    for length in range(0, 60 if kind == "4007" else len(whole) - 20, 4):
        decoder = SbfDecoder(TIME)
        decode(encode.encode_meas_epoch(an_epoch(ALL[:1])) if kind == "4000" else b"", decoder)
        decoder._extra_comes = kind == "4000"
        decode(encode.encode_meas_epoch(an_epoch(ALL[:1])) if kind == "4000" else b"", decoder)
        decode(encode.block(kind, TIME, whole[14 : 14 + length]), decoder)
        assert sum(count for name, count in decoder.counters.rejected.items() if name == f"sbf/{kind} length") == 1, length


KINDS = [4000, 4002, 4004, 4007, 4017, 4022, 4023, 4026, 4027, 4047, 4066, 4081, 4095, 4120, 5891, 5893, 5902, 5922, 5938, 5939, 5942, 5943]


@given(parts=st.lists(st.tuples(st.sampled_from(KINDS), st.binary(max_size=400), st.booleans()), max_size=12))
@settings(max_examples=150, deadline=None)
def test_random_blocks_never_raise(parts: list[tuple[int, bytes, bool]]):
    """Whatever passes the checksum, with and without a time."""
    stream = StreamDecoder(StreamOptions(approximate_time=TIME))
    stream.feed(b"".join(encode.block(str(kind), TIME if timed else None, payload) for kind, payload, timed in parts))
    stream.flush()
    assert stream.framing.frames.total() == len(parts)


@given(which=st.integers(0, len(BLOCKS) - 1), at=st.integers(0, 400), new=st.binary(min_size=1, max_size=8))
@settings(max_examples=150, deadline=None)
def test_damaged_contents_never_raise(which: int, at: int, new: bytes):
    """Right blocks with some bytes changed and the checksum made right again."""
    payload = bytearray(BLOCKS[which][14:])
    payload[at : at + len(new)] = new
    kind = struct.unpack_from("<H", BLOCKS[which], 4)[0] & 0x1FFF
    stream = StreamDecoder()
    stream.feed(encode.block(str(kind), TIME, bytes(payload)) + encode.encode_meas_epoch(an_epoch(ALL)))
    stream.flush()


def test_ignored_blocks_are_counted():
    decoder = SbfDecoder()
    assert decode(encode.block("4014", TIME, bytes(20)) + encode.block("5922", TIME, b""), decoder) == []
    assert (decoder.counters.ignored, decoder.counters.decoded) == ({"sbf/4014": 1}, {"sbf/5922": 1})
