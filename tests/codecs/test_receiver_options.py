"""RTKLIB's receiver options: what their text says, and what they do to messages."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtkmesh.codecs.messages import Frame, Message, Protocol
from rtkmesh.codecs.option_stage import OptionStage, rounded
from rtkmesh.codecs.rtcm3 import Rtcm3Decoder
from rtkmesh.codecs.rtcm3_encode import encode_ephemeris as rtcm3_ephemeris
from rtkmesh.codecs.rtcm3_encode import encode_epoch, encode_station
from rtkmesh.codecs.stream import StreamDecoder, StreamOptions
from rtkmesh.codecs.ubx_encode import encode_ephemeris as ubx_ephemeris
from rtkmesh.codecs.ubx_encode import encode_rawx
from rtkmesh.errors import OptionError
from rtkmesh.gnss.ephemeris import GlonassEphemeris, KeplerEphemeris, NavigationMessage, ReferenceStation
from rtkmesh.gnss.epoch import HALF_CYCLE, SLIP, Epoch, make_epoch
from rtkmesh.gnss.receiver_options import ReceiverOptions, parse_receiver_options
from rtkmesh.gnss.signals import carrier_hz, satellite_number, signal_number
from rtkmesh.gnss.time import GpsTime
from rtkmesh.simulation.sky import SATELLITES, broadcast
from rtkmesh.simulation.ubx_stream import frame_start

TIME = GpsTime(2445, 532_800.0)
C_MPS = 299_792_458.0


@pytest.mark.parametrize(
    ("text", "options"),
    [
        ("", ReceiverOptions()),
        ("-EPHALL -TADJ=0.1", ReceiverOptions(all_ephemerides=True, rounding_s=0.1)),
        ("-GALINAV", ReceiverOptions(galileo="inav")),
        ("-GALFNAV -INVCP", ReceiverOptions(galileo="fnav")),
        ("-STD_SLIP=5 -MAX_STD_CP=7", ReceiverOptions(slip_sigma=5, drop_sigma=7)),
        ("-STA=42 -INVPRR", ReceiverOptions(station=42, invert_doppler=True)),
        ("-AUX1", ReceiverOptions(antenna=1)),
        ("-AUX2", ReceiverOptions(antenna=2)),
        ("-GL1W -GL2X -RL2C -EL6B -CL1P -JL1L", ReceiverOptions(signals=("G1W", "G2X", "R2C", "E6B", "C1P", "J1L"))),
        ("-MULTICODE -RCVSTDS -RT_INP -NO_MEAS3 -IHALFC -TRKM_ADJ=1", ReceiverOptions()),
    ],
)
def test_the_text_says_the_options(text: str, options: ReceiverOptions):
    """All of demo5's that concern receivers which are read here; those that ask for what is done anyway tell why."""
    found = parse_receiver_options(text)
    assert found == options
    assert len(found.notes) == len([word for word in text.split() if word.split("=")[0] in NEEDLESS])


NEEDLESS = ("-MULTICODE", "-RCVSTDS", "-RT_INP", "-NO_MEAS3", "-IHALFC", "-TRKM_ADJ", "-INVCP")


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("-EPHAL", "no receiver option '-EPHAL'; did you mean -EPHALL?"),
        ("-TADJ", "-TADJ needs a number from 0 to 60, as in -TADJ=60"),
        ("-TADJ=x", "-TADJ needs a number from 0 to 60"),
        ("-STA=5000", "-STA needs a whole number from 0 to 4095"),
        ("-STA=nan", "-STA needs a whole number"),
        ("-TADJ=inf", "-TADJ needs a number"),
        ("-EPHALL=1", "-EPHALL takes no value"),
        ("-GALINAV -GALFNAV", "-GALFNAV contradicts an option before it"),
        ("-AUX1 -AUX2", "-AUX2 contradicts"),
        ("-NO_MEAS2", "-NO_MEAS2 is not possible: it would leave no observations"),
        ("-GLOBIAS=0.3", "-GLOBIAS is not possible: GLONASS code biases are learned"),
        ("GL2L", "no receiver option 'GL2L'; did you mean -GL2L?"),
        ("-XL2L", "no receiver option '-XL2L'"),
    ],
)
def test_faults_are_named_with_the_nearest_right_word(text: str, error: str):
    with pytest.raises(OptionError, match=error.replace("?", r"\?")):
        parse_receiver_options(text)


@given(st.text(max_size=40))
def test_any_text_parses_or_is_a_fault_of_the_caller(text: str):
    try:
        options = parse_receiver_options(text)
    except OptionError:
        return
    assert not text.split() or options.notes or options != ReceiverOptions()


def messages_of(data: bytes, options: str = "", near: GpsTime | None = TIME) -> list[Message]:
    decoder = StreamDecoder(StreamOptions(approximate_time=near, receiver=parse_receiver_options(options)))
    return [message for _, found in decoder.feed(data) for message in found] + decoder.flush()


def epochs_of(messages: list[Message]) -> list[Epoch]:
    return [message for message in messages if isinstance(message, Epoch)]


def an_epoch(time: GpsTime = TIME, **columns: object) -> Epoch:
    values: dict[str, object] = {
        "satellite": [satellite_number(name) for name in ("G05", "G05", "G07", "G07", "R09")],
        "signal": [signal_number(code) for code in ("1C", "2L", "1C", "2S", "1C")],
        "channel": [127, 127, 127, 127, -3],
        "pseudorange_m": [2.2e7, 2.2e7 + 3.0, 2.3e7, 2.3e7 + 3.0, 2.1e7],
        "phase_cyc": [1.156e8, 0.9e8, 1.2e8, 0.94e8, 1.1e8],
        "doppler_hz": [1000.0, 800.0, -500.0, -400.0, 77.0],
        "cn0_dbhz": [45.0] * 5,
        "lock_s": [30.0] * 5,
        "phase_sigma_cyc": [0.004, 0.02, 0.024, 0.04, 0.008],
    }
    return make_epoch(time, **(values | columns))


def test_epochs_are_moved_to_round_times_with_their_ranges():
    """-TADJ: as if the receiver's clock had been right: ranges and phases change by what light does in that time, Dopplers do not."""
    sent = an_epoch(TIME + 0.0995)
    (found,) = epochs_of(messages_of(encode_rawx(sent), "-TADJ=0.1"))
    assert found.time == TIME + 0.1
    np.testing.assert_allclose(found.pseudorange_m, sent.pseudorange_m + 0.0005 * C_MPS, atol=1e-4)
    hz = [carrier_hz(int(s), int(g), int(c)) for s, g, c in zip(sent.satellite, sent.signal, sent.channel, strict=True)]
    np.testing.assert_allclose(found.phase_cyc, sent.phase_cyc + 0.0005 * np.array(hz), atol=1e-4)
    np.testing.assert_array_equal(found.doppler_hz, sent.doppler_hz)
    assert rounded(an_epoch(GpsTime(2445, 604_799.9999)), 1.0).time == GpsTime(2446, 0.0)
    late = rounded(an_epoch(TIME, channel=[127] * 5), 1.0)
    assert np.isnan(late.phase_cyc).tolist() == [False] * 4 + [True]  # without its channel a phase cannot be moved


def test_dopplers_of_rtcm3_are_turned():
    """-INVPRR; those of raw measurements stay."""
    sent = an_epoch()
    (raw,) = epochs_of(messages_of(encode_rawx(sent), "-INVPRR"))
    np.testing.assert_array_equal(raw.doppler_hz, sent.doppler_hz)
    data = b"".join(encode_epoch(sent, 1))
    (plain,), (turned,) = (epochs_of(messages_of(data, text)) for text in ("", "-INVPRR"))
    np.testing.assert_array_equal(turned.doppler_hz, -plain.doppler_hz)
    np.testing.assert_array_equal(turned.phase_cyc, plain.phase_cyc)


def test_the_receivers_sigma_marks_slips_and_drops_phases():
    """Steps of 0.004 cycles: -STD_SLIP from that on, -MAX_STD_CP above that; the sigmas here are 1, 5, 6, 10 and 2 steps."""
    (found,) = epochs_of(messages_of(encode_rawx(an_epoch()), "-STD_SLIP=6 -MAX_STD_CP=6"))
    assert (found.flags & SLIP).tolist() == [0, 0, SLIP, 0, 0]
    assert np.isnan(found.phase_cyc).tolist() == [False, False, False, True, False]


def test_a_slip_of_a_phase_that_was_dropped_is_told_with_the_next():
    stage = OptionStage(parse_receiver_options("-MAX_STD_CP=5"))
    bad, good = an_epoch(phase_sigma_cyc=[0.04] * 5, flags=[SLIP, 0, 0, HALF_CYCLE, 0]), an_epoch(phase_sigma_cyc=[0.004] * 5)
    flags = [stage.epoch(epoch, Protocol.UBX).flags.tolist() for epoch in (bad, good, good)]
    assert flags == [[0] * 5, [SLIP, 0, 0, 0, 0], [0] * 5]


def test_the_wanted_signal_is_the_only_one_of_its_band_where_it_is():
    """-GL2L: a satellite with 2L has no other L2 signal; one without it keeps what it has; other systems are left alone."""
    names = [("G05", "1C"), ("G05", "2L"), ("G05", "2W"), ("G07", "1C"), ("G07", "2W"), ("R09", "2C"), ("R09", "2P")]
    epoch = make_epoch(TIME, satellite=[satellite_number(n) for n, _ in names], signal=[signal_number(c) for _, c in names])
    kept = OptionStage(parse_receiver_options("-GL2L")).epoch(epoch, Protocol.SBF)
    assert [row[:2] for row in kept.rows()] == [pair for pair in names if pair != ("G05", "2W")]


def ephemerides_of(messages: list[Message]) -> list[KeplerEphemeris | GlonassEphemeris]:
    return [message for message in messages if isinstance(message, KeplerEphemeris | GlonassEphemeris)]


@pytest.mark.parametrize("satellite", SATELLITES[::6])
def test_all_ephemerides_pass_if_wanted(satellite: int):
    """-EPHALL: three times the same set of UBX subframes, and of RTCM 3; without it once."""
    e = broadcast(satellite, TIME)
    raw = b"".join(part for k in range(3) for part in ubx_ephemeris(e, frame_start(satellite, TIME) + 30.0 * k))
    for data in (raw, rtcm3_ephemeris(e) * 3):
        assert [len(ephemerides_of(messages_of(data, text))) for text in ("", "-EPHALL")] == [1, 3]


def test_one_kind_of_galileo_ephemeris_can_be_chosen():
    """-GALINAV, -GALFNAV; the other systems are left alone."""
    inav = next(e for s in SATELLITES if isinstance(e := broadcast(s, TIME), KeplerEphemeris) and e.message is NavigationMessage.INAV)
    gps = next(e for s in SATELLITES if isinstance(e := broadcast(s, TIME), KeplerEphemeris) and e.message is NavigationMessage.LNAV)
    fnav = replace(inav, message=NavigationMessage.FNAV, group_delay_s=(inav.group_delay_s[0], 0.0))
    data = b"".join(rtcm3_ephemeris(e) for e in (inav, fnav, gps))
    found = {text: [e.message for e in ephemerides_of(messages_of(data, text)) if isinstance(e, KeplerEphemeris)] for text in KINDS}
    assert found == KINDS


INAV, FNAV, LNAV = NavigationMessage.INAV, NavigationMessage.FNAV, NavigationMessage.LNAV
KINDS = {"": [INAV, FNAV, LNAV], "-GALINAV": [INAV, LNAV], "-GALFNAV": [FNAV, LNAV]}


def test_messages_of_another_station_are_left_out():
    """-STA: observations and station messages name theirs, ephemerides none."""
    mine = [*encode_epoch(an_epoch(), 42), *encode_station(ReferenceStation(42, (3.8e6, 9.0e5, 5.0e6)))]
    other = [*encode_epoch(an_epoch(TIME + 1.0), 43), *encode_station(ReferenceStation(43, (3.8e6, 9.0e5, 5.0e6)))]
    decoder = Rtcm3Decoder(TIME, station=42)
    parts = [*mine, *other, rtcm3_ephemeris(broadcast(SATELLITES[0], TIME))]
    found = [message for data in parts for message in decoder.decode(Frame(Protocol.RTCM3, "", data))] + decoder.flush()
    assert [message.time for message in epochs_of(found)] == [TIME]
    assert {message.station_id for message in found if isinstance(message, ReferenceStation)} == {42}
    assert len(ephemerides_of(found)) == 1
    assert sum(count for name, count in decoder.counters.ignored.items() if name.endswith("of another station")) == len(other)
