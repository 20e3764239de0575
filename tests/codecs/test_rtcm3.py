"""The RTCM 3 decoder: which messages make an epoch, whose week it is, what is counted."""

from collections.abc import Iterable

import numpy as np
import pytest

from rtkmesh.codecs.messages import Frame, Message, Protocol
from rtkmesh.codecs.rtcm3 import MAX_HELD, Rtcm3Decoder
from rtkmesh.codecs.rtcm3_encode import encode_ephemeris, encode_epoch, frame
from rtkmesh.gnss.constants import SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.ephemeris import KeplerEphemeris, NavigationMessage
from rtkmesh.gnss.epoch import HALF_CYCLE, SLIP, Epoch, make_epoch
from rtkmesh.gnss.signals import NO_CHANNEL, carrier_hz, satellite_number, signal_number
from rtkmesh.gnss.time import GpsTime

SATURDAY = GpsTime(2009, 604790.0)
SYSTEMS = (("G05", "1C"), ("G05", "2L"), ("R07", "1C"), ("E11", "1X"), ("C23", "2I"))


def an_epoch(time: GpsTime, signals: Iterable[tuple[str, str]] = SYSTEMS, lock_s: float = 100.0, flags: int = 0) -> Epoch:
    names = list(signals)
    satellite, signal = [satellite_number(name) for name, _ in names], [signal_number(code) for _, code in names]
    channel = [5 if name[0] == "R" else NO_CHANNEL for name, _ in names]
    carrier = np.array([carrier_hz(*one) for one in zip(satellite, signal, channel, strict=True)])
    range_m = 2.1e7 + 1e4 * np.array(satellite) + 0.3 * np.array(signal)
    full = len(names)
    return make_epoch(
        time, satellite=satellite, signal=signal, channel=channel, flags=np.full(full, flags), pseudorange_m=range_m,
        phase_cyc=range_m * carrier / SPEED_OF_LIGHT_MPS, doppler_hz=np.full(full, 123.0), cn0_dbhz=np.full(full, 44.0),
        lock_s=np.full(full, lock_s),
    )  # fmt: skip


def as_frame(data: bytes) -> Frame:
    return Frame(Protocol.RTCM3, str(data[3] << 4 | data[4] >> 4), data)


def decode(decoder: Rtcm3Decoder, frames: Iterable[bytes]) -> list[Message]:
    return [message for data in frames for message in decoder.decode(as_frame(data))]


def epochs_of(messages: Iterable[Message]) -> list[Epoch]:
    return [message for message in messages if isinstance(message, Epoch)]


def a_galileo_ephemeris(toe: GpsTime) -> KeplerEphemeris:
    return KeplerEphemeris(
        satellite=satellite_number("E11"), message=NavigationMessage.INAV, iode=77, iodc=77, toe=toe, toc=toe, transmitted=toe, health=0,
        accuracy_m=3.12, fit_s=14400.0, sqrt_a=5440.6, eccentricity=2e-4, m0_rad=1.0, delta_n_radps=3e-9, omega0_rad=2.0, omega_rad=-1.0,
        omega_dot_radps=-5e-9, i0_rad=0.98, idot_radps=1e-10, cuc_rad=1e-6, cus_rad=2e-6, crc_m=100.0, crs_m=-50.0, cic_rad=1e-8,
        cis_rad=-1e-8, af0_s=1e-4, af1=1e-12, af2=0.0, group_delay_s=(1e-9, 2e-9),
    )  # fmt: skip


def test_an_epoch_of_all_systems_is_gathered_by_the_multiple_message_bit():
    """An epoch comes out with its last message, not later, with all systems in it."""
    decoder, frames = Rtcm3Decoder(SATURDAY), encode_epoch(an_epoch(SATURDAY), 7)
    assert len(frames) == 4
    assert decode(decoder, frames[:-1]) == []
    (epoch,) = epochs_of(decode(decoder, frames[-1:]))
    assert epoch.time == SATURDAY
    assert [row[:2] for row in epoch.rows()] == list(SYSTEMS)


def test_the_week_changes_once_at_the_rollover_for_all_systems():
    """Epochs around the end of the GPS week, where BeiDou's tags stay 14 s in the old week and GLONASS has another day, step by 1 s."""
    times = [SATURDAY + float(k) for k in range(40)]
    decoder = Rtcm3Decoder(SATURDAY)
    epochs = epochs_of(decode(decoder, (data for time in times for data in encode_epoch(an_epoch(time), 1))))
    assert [epoch.time for epoch in epochs] == times
    assert all(len(epoch) == len(SYSTEMS) for epoch in epochs)
    assert not decoder.counters.rejected


def test_a_negative_beidou_tag_belongs_to_the_new_week():
    """Septentrio PolaRx5 sends BDT in the first 14 s of the GPS week as a negative number of 30 bits."""
    time = GpsTime(2010, 3.0)
    gps, beidou = (encode_epoch(an_epoch(time, [signal]), 1)[0] for signal in (SYSTEMS[0], SYSTEMS[4]))
    head = int.from_bytes(beidou[3:11], "big") & ~(0x3FFFFFFF << 10) | ((1 << 30) + 3000 - 14000) << 10
    decoder = Rtcm3Decoder(SATURDAY)
    first = int.from_bytes(gps[3:11], "big") | 1 << 9
    messages = decode(decoder, [frame(first.to_bytes(8, "big") + gps[11:-3]), frame(head.to_bytes(8, "big") + beidou[11:-3])])
    assert [(epoch.time, len(epoch)) for epoch in epochs_of(messages)] == [(time, 2)]


def test_a_lost_last_message_neither_merges_nor_loses_epochs():
    """If the message that ends an epoch is lost, the next epoch brings it out, complete but for what was lost."""
    decoder = Rtcm3Decoder(SATURDAY)
    first, second = (encode_epoch(an_epoch(SATURDAY + k), 1) for k in (0.0, 1.0))
    epochs = epochs_of(decode(decoder, first[:-1] + second))
    assert [(epoch.time, len(epoch)) for epoch in epochs] == [(SATURDAY, 4), (SATURDAY + 1.0, 5)]


def test_flush_brings_out_the_unfinished_epoch():
    decoder = Rtcm3Decoder(SATURDAY)
    assert decode(decoder, encode_epoch(an_epoch(SATURDAY), 1)[:1]) == []
    assert [len(epoch) for epoch in epochs_of(decoder.flush())] == [2]
    assert decoder.flush() == []


def test_late_and_repeated_messages_are_counted_and_change_nothing():
    """Messages of an epoch that is out already, or of an older one, give no epoch."""
    decoder = Rtcm3Decoder(SATURDAY)
    streams = [encode_epoch(an_epoch(SATURDAY + float(k)), 1) for k in range(3)]
    epochs = epochs_of(decode(decoder, [*streams[0], *streams[1], *streams[0], *streams[1], *streams[2]]))
    assert [epoch.time for epoch in epochs] == [SATURDAY + float(k) for k in range(3)]
    assert sum(decoder.counters.rejected.values()) == 8


def test_a_stream_with_wrong_end_marks_is_gathered_by_time_and_trusted_again_later():
    """A sender that marks every message as the last one loses at most one epoch's systems; a right stream regains its latency."""
    decoder = Rtcm3Decoder(SATURDAY)
    frames = [data for k in range(6) for data in encode_epoch(an_epoch(SATURDAY + float(k)), 1)]
    unmarked = [frame((int.from_bytes(data[3:11], "big") & ~(1 << 9)).to_bytes(8, "big") + data[11:-3]) for data in frames]
    epochs = epochs_of(decode(decoder, unmarked)) + epochs_of(decoder.flush())
    assert [len(epoch) for epoch in epochs] == [2, 5, 5, 5, 5, 5]
    for k in range(6, 30):
        last = epochs_of(decode(decoder, encode_epoch(an_epoch(SATURDAY + float(k)), 1)))
    assert [epoch.time for epoch in last] == [SATURDAY + 29.0]


def test_a_jump_of_time_must_be_confirmed():
    """One epoch with a time of nonsense is left out; a receiver that really changed its clock is followed after five messages."""
    decoder = Rtcm3Decoder(SATURDAY)
    gps = SYSTEMS[:1]
    frames = [data for k in (0.0, -90000.0, 1.0, 2.0) for data in encode_epoch(an_epoch(SATURDAY + k, gps), 1)]
    assert [epoch.time for epoch in epochs_of(decode(decoder, frames))] == [SATURDAY, SATURDAY + 1.0, SATURDAY + 2.0]
    back = [data for k in range(7) for data in encode_epoch(an_epoch(SATURDAY + (k - 90000.0), gps), 1)]
    assert [epoch.time - SATURDAY for epoch in epochs_of(decode(decoder, back))] == [-89996.0, -89995.0, -89994.0]


def test_glonass_day_contradicting_the_clock_is_not_believed():
    """Some senders put 0 as GLONASS day of week: beside another system the time of day is enough."""
    decoder = Rtcm3Decoder(SATURDAY)
    gps, glonass = encode_epoch(an_epoch(SATURDAY, [SYSTEMS[0], SYSTEMS[2]]), 1)
    head = int.from_bytes(glonass[3:11], "big") & ~(7 << 37) | 3 << 37
    (epoch,) = epochs_of(decode(decoder, [gps, frame(head.to_bytes(8, "big") + glonass[11:-3])]))
    assert [row[0] for row in epoch.rows()] == ["G05", "R07"]


def test_sbas_tag_with_the_time_of_day_belongs_to_its_epoch():
    """A sender was seen that tags SBAS messages with the time of day instead of the week."""
    decoder = Rtcm3Decoder(SATURDAY)
    gps, sbas = encode_epoch(an_epoch(SATURDAY, [("G05", "1C"), ("S22", "1C")]), 1)
    assert [sbas[3] << 4 | sbas[4] >> 4, decoder.decode(as_frame(gps))] == [1107, []]
    head = int.from_bytes(sbas[3:11], "big") & ~(0x3FFFFFFF << 10) | int(SATURDAY.tow_s % 86400.0) * 1000 << 10
    (epoch,) = epochs_of(decode(decoder, [frame(head.to_bytes(8, "big") + sbas[11:-3])]))
    assert [row[0] for row in epoch.rows()] == ["G05", "S22"]


def test_observations_wait_for_a_time_and_then_come_in_order():
    """Without an approximate time epochs are held until an ephemeris tells the week; none is lost up to the limit."""
    decoder = Rtcm3Decoder()
    times = [SATURDAY + float(k) for k in range(3)]
    assert decode(decoder, (data for time in times for data in encode_epoch(an_epoch(time), 1))) == []
    messages = decode(decoder, [encode_ephemeris(a_galileo_ephemeris(GpsTime(2009, 600000.0)))])
    assert [epoch.time for epoch in epochs_of(messages)] == times


def test_what_waits_for_a_time_is_bounded_and_counted():
    decoder = Rtcm3Decoder()
    data = encode_epoch(an_epoch(SATURDAY, SYSTEMS[:1]), 1)[0]
    assert decode(decoder, [data] * (MAX_HELD + 10)) == []
    assert decoder.counters.rejected["rtcm3/1077 time unknown"] == 10
    assert decoder.flush() == []
    assert decoder.counters.rejected["rtcm3/1077 time unknown"] == MAX_HELD + 10


def test_an_approximate_time_decides_only_the_week():
    """Three days off on either side gives the same epochs; a later time from elsewhere corrects a wrong week."""
    frames = encode_epoch(an_epoch(SATURDAY), 1)
    for days in (-3.0, 3.0):
        assert [epoch.time for epoch in epochs_of(decode(Rtcm3Decoder(SATURDAY + days * 86400.0), frames))] == [SATURDAY]
    decoder = Rtcm3Decoder(GpsTime(2300, 0.0))
    assert epochs_of(decode(decoder, frames))[0].time.week in (2299, 2300)
    decoder.set_approximate_time(SATURDAY)
    assert [epoch.time for epoch in epochs_of(decode(decoder, encode_epoch(an_epoch(SATURDAY + 1.0), 1)))] == [SATURDAY + 1.0]


def test_falling_lock_time_is_a_slip_and_unresolved_half_cycles_are_flagged():
    """SLIP where the lock time fell, HALF_CYCLE as sent, nothing where the lock goes on."""
    decoder = Rtcm3Decoder(SATURDAY)
    locks = ((0.0, 100.0, 0), (1.0, 101.0, 0), (2.0, 0.5, HALF_CYCLE), (3.0, 1.5, 0))
    frames = [data for k, lock_s, flags in locks for data in encode_epoch(an_epoch(SATURDAY + k, lock_s=lock_s, flags=flags), 1)]
    assert [set(epoch.flags.tolist()) for epoch in epochs_of(decode(decoder, frames))] == [{0}, {0}, {SLIP | HALF_CYCLE}, {0}]


def test_glonass_phase_needs_a_channel():
    """Without a channel (MSM4 before any 1020) pseudoranges come and phases do not; MSM7 teaches the channel to MSM4."""
    decoder = Rtcm3Decoder(SATURDAY)
    signal = [SYSTEMS[2]]
    before = epochs_of(decode(decoder, encode_epoch(an_epoch(SATURDAY, signal), 1, msm=4)))[0]
    decode(decoder, encode_epoch(an_epoch(SATURDAY + 1.0, signal), 1, msm=7))
    after = epochs_of(decode(decoder, encode_epoch(an_epoch(SATURDAY + 2.0, signal), 1, msm=4)))[0]
    assert np.isfinite(before.pseudorange_m).all()
    assert np.isnan(before.phase_cyc).all()
    assert np.isfinite(after.phase_cyc).all()
    assert after.channel.tolist() == [5]
    assert decoder.counters.rejected["rtcm3/1084 cell of unknown frequency channel"] == 1


@pytest.mark.parametrize(
    ("number", "name"),
    [
        (1013, " (system parameters, not used)"), (1029, " (text, not used)"), (1057, " (SSR GPS orbits, not used)"),
        (1062, " (SSR GPS high-rate clocks, not used)"), (1066, " (SSR GLONASS orbits and clocks, not used)"),
        (1243, " (SSR Galileo orbits and clocks, not used)"), (1260, " (SSR BeiDou code biases, not used)"),
        (1270, " (SSR BeiDou phase biases, not used)"), (4076, " (IGS SSR, not used)"), (1071, " (compact MSM, not used)"),
        (1001, " (without the modulus of the pseudorange, not used)"), (4072, " (u-blox reference station, not used)"), (4095, ""), (0, ""),
    ],
)  # fmt: skip
def test_other_messages_are_counted_as_ignored_by_what_they_are(number: int, name: str):
    decoder = Rtcm3Decoder(SATURDAY)
    assert decode(decoder, [frame((number << 4).to_bytes(2, "big") + bytes(30))]) == []
    assert decoder.counters.ignored == {f"rtcm3/{number}{name}": 1}


def test_an_overtaken_epoch_is_decoded_once_and_without_false_slips():
    """Epochs 1, 3, 2, 2, 4: all four come out, the repeated one is counted, lock times that are behind mean no slip."""
    start = GpsTime(2300, 345_600.0)

    def frames(seconds: float) -> list[Frame]:
        columns = {"satellite": [3, 7], "signal": [28, 28], "pseudorange_m": [2.1e7, 2.2e7], "phase_cyc": [1.1e8, 1.15e8]}
        epoch = make_epoch(start + seconds, **columns, cn0_dbhz=[45.0, 44.0], lock_s=[100.0 + seconds] * 2)
        return [Frame(Protocol.RTCM3, "1077", data) for data in encode_epoch(epoch, 5)]

    decoder = Rtcm3Decoder(start)
    sent = [frame for seconds in (1.0, 3.0, 2.0, 2.0, 4.0) for frame in frames(seconds)]
    epochs = [message for frame in sent for message in decoder.decode(frame) if isinstance(message, Epoch)]
    assert [epoch.time - start for epoch in epochs] == [1.0, 3.0, 2.0, 4.0]
    assert not any(epoch.flags.any() for epoch in epochs)
    assert sum(decoder.counters.rejected.values()) == 1
