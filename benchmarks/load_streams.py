"""Four receivers' streams at many epochs per second, cut from recordings: what comes with an epoch comes with every epoch, what is
broadcast slowly (navigation data, the station) keeps its own pace.

A recording of 1 Hz is played epoch by epoch at the wanted rate. Its subframes and ephemerides are not played faster: those of one
recorded second are spread over the epochs of one played second. Septentrio's and Unicore's streams are encoded from the observations and
ephemerides of the RTCM 3 recording, NAV-SAT from those of the u-blox one; all else is as it was recorded.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from struct import pack, unpack_from
from typing import Final

from rtkmesh.codecs.framing import Framer
from rtkmesh.codecs.messages import Frame, Protocol
from rtkmesh.codecs.sbf_encode import encode_meas_epoch, encode_meas_extra, encode_navigation, encode_pvt
from rtkmesh.codecs.stream import StreamDecoder, StreamOptions
from rtkmesh.codecs.ubx import RAWX, SFRBX
from rtkmesh.codecs.ubx_encode import frame
from rtkmesh.codecs.unicore_encode import encode_ephemeris, encode_observations, encode_position
from rtkmesh.gnss.ephemeris import GlonassEphemeris, KeplerEphemeris, NavigationMessage, ReceiverFix
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.time import GpsTime
from rtkmesh_services.ingest.replay import date_of

UBX_FILE: Final = "dec_ubx/gnss_imu_walk_1730.ubx"
RTCM3_FILE: Final = "stromlo_rtcm/week-rollover-STR17.rtcm3"
RTCM3_DATE: Final = "2018-07-14"
PLACE: Final = (-0.617, 2.600, 800.0)  # where the station of that recording stands, roughly (rad, rad, m)
_MSM_OR_LEGACY: Final = ("100", "101", "107", "108", "109", "111", "112")
_SENT_RAW: Final = (NavigationMessage.LNAV, NavigationMessage.INAV, NavigationMessage.D1)

Slot = tuple[float, bytes]  # time of week of the epoch, and the bytes that end with its last byte


@dataclass(frozen=True, slots=True)
class Receiver:
    """One stream. ``date`` is that of the configuration; ``signals`` and ``frames`` are means per epoch."""

    name: str
    slots: list[Slot]
    signals: float
    frames: float
    date: str = ""

    @property
    def bytes_per_epoch(self) -> float:
        """Mean length of a slot."""
        return sum(len(data) for _, data in self.slots) / len(self.slots)


@dataclass(frozen=True, slots=True)
class Parts:
    """A recording by epochs: time of week of each, what came with it, and what was broadcast in each second."""

    epochs: list[Slot]
    seconds: list[list[bytes]]


def receivers(data: Path, rate: int, count: int) -> list[Receiver]:
    """Return the four streams with so many epochs each."""
    rtcm3 = (data / RTCM3_FILE).read_bytes()
    epochs, ephemerides = decoded(rtcm3)
    made = {
        "ubx": ubx_parts((data / UBX_FILE).read_bytes(), count),
        "rtcm3": rtcm3_parts(rtcm3),
        "sbf": Parts([(epoch.time.tow_s, septentrio(epoch)) for epoch in islice(epochs, count)], [_raw_blocks(e) for e in ephemerides]),
        "unicore": Parts([(epoch.time.tow_s, unicore(epoch)) for epoch in islice(epochs, count)], [_log_of(e) for e in ephemerides]),
    }
    dates = {"rtcm3": RTCM3_DATE}
    return [_receiver(name, spread(parts, rate, count), dates.get(name, "")) for name, parts in made.items()]


def _receiver(name: str, slots: list[Slot], date: str) -> Receiver:
    decoder = StreamDecoder(StreamOptions(approximate_time=date_of(date)))
    found = [pair for _, data in slots for pair in decoder.feed(data)]
    signals = sum(len(message.satellite) for _, messages in found for message in messages if isinstance(message, Epoch))
    return Receiver(name, slots, signals / len(slots), len(found) / len(slots), date)


def spread(parts: Parts, rate: int, count: int) -> list[Slot]:
    """Return the epochs as slots: second k of what was broadcast goes, before the epochs, into slots k * rate to (k + 1) * rate - 1."""
    slots: list[Slot] = []
    for number, (tow_s, data) in enumerate(islice(parts.epochs, count)):
        second, within = divmod(number, rate)
        slow = parts.seconds[second % len(parts.seconds)] if parts.seconds else []
        first, last = (len(slow) * step // rate for step in (within, within + 1))
        slots.append((tow_s, b"".join(slow[first:last]) + data))
    return slots


def parts_of(frames: Iterable[Frame], is_slow: Callable[[Frame], bool], ends: Callable[[Frame], float | None]) -> Parts:
    """Cut a recording. ``ends`` returns the time of week of the epoch that a frame ends, None if it ends none."""
    parts, fast, slow = Parts([], []), list[bytes](), dict[int, list[bytes]]()
    second = 0
    for one in frames:
        if is_slow(one):
            slow.setdefault(second, []).append(one.data)
            continue
        fast.append(one.data)
        tow_s = ends(one)
        if tow_s is not None:
            parts.epochs.append((tow_s, b"".join(fast)))
            fast, second = [], int(tow_s)
    whole = range(min(slow, default=0) + 1, max(slow, default=0))  # those at the ends are cut off
    return Parts(parts.epochs, [slow.get(number, []) for number in whole])


def ubx_parts(data: bytes, count: int) -> Parts:
    """Return u-blox's recording with a NAV-SAT after every epoch, again and again with later times until it has so many epochs."""
    frames = Framer().feed(data)
    parts = parts_of(frames, lambda one: one.kind == SFRBX, lambda one: rawx_tow_s(one.data) if one.kind == RAWX else None)
    epochs = [(tow_s, epoch + nav_sat(epoch)) for tow_s, epoch in parts.epochs]
    span_s = epochs[-1][0] - epochs[0][0] + 1.0
    repeated = [_later(slot, span_s * turn) for turn in range(count // len(epochs) + 1) for slot in epochs]
    return Parts(repeated[:count], parts.seconds)


def rawx_tow_s(data: bytes) -> float:
    """Return the time of week of an RXM-RAWX frame."""
    return float(unpack_from("<d", data, 6)[0])


def _later(slot: Slot, shift_s: float) -> Slot:
    """Return the epoch with its RXM-RAWX (whole frames, one RAWX) at a later time of week."""
    tow_s = slot[0] + shift_s
    return tow_s, b"".join(_retagged(one.data, tow_s) if one.kind == RAWX else one.data for one in Framer().feed(slot[1]))


def _retagged(rawx: bytes, tow_s: float) -> bytes:
    return frame(0x02, 0x15, pack("<d", tow_s) + rawx[14:-2])


def nav_sat(epoch: bytes) -> bytes:
    """Return the NAV-SAT frame of the satellites in the RXM-RAWX among these frames (F9 HPG 1.32, 3.15.18), elevations made up."""
    rawx = next(one.data for one in Framer([Protocol.UBX]).feed(epoch) if one.kind == RAWX)
    strength: dict[tuple[int, int], int] = {}
    for start in range(22, len(rawx) - 2, 32):
        satellite, cn0 = (rawx[start + 20], rawx[start + 21]), rawx[start + 26]
        strength[satellite] = max(cn0, strength.get(satellite, 0))
    rows = (pack("<BBBbhhI", *satellite, cn0, 45, 180, 0, 0x1F) for satellite, cn0 in strength.items())
    return frame(0x01, 0x35, pack("<IBB2x", round(rawx_tow_s(rawx) * 1e3) % 604800000, 1, len(strength)) + b"".join(rows))


def rtcm3_parts(data: bytes) -> Parts:
    """Return an RTCM 3 recording: observations epoch by epoch, all other messages at their pace."""
    frames = Framer([Protocol.RTCM3]).feed(data)
    decoder = StreamDecoder(StreamOptions(approximate_time=date_of(RTCM3_DATE)))

    def ends(one: Frame) -> float | None:
        found = [message for _, messages in decoder.feed(one.data) for message in messages if isinstance(message, Epoch)]
        return found[-1].time.tow_s if found else None

    return parts_of(frames, lambda one: not one.kind.startswith(_MSM_OR_LEGACY), ends)


def decoded(data: bytes) -> tuple[list[Epoch], list[KeplerEphemeris | GlonassEphemeris]]:
    """Return the epochs and the ephemerides of an RTCM 3 recording."""
    found = StreamDecoder(StreamOptions(approximate_time=date_of(RTCM3_DATE))).feed(data)
    messages = [message for _, some in found for message in some]
    epochs = [message for message in messages if isinstance(message, Epoch)]
    return epochs, [message for message in messages if isinstance(message, KeplerEphemeris | GlonassEphemeris)]


def _fix(time: GpsTime) -> ReceiverFix:
    lat_rad, lon_rad, height_m = PLACE
    return ReceiverFix(
        time=time, lat_rad=lat_rad, lon_rad=lon_rad, height_m=height_m, fix=3, satellites=30, horizontal_sigma_m=1.0, vertical_sigma_m=2.0,
        velocity_ned_mps=(0.0, 0.0, 0.0),
    )  # fmt: skip


def septentrio(epoch: Epoch) -> bytes:
    """Return what a Septentrio receiver sends with an epoch: MeasEpoch, MeasExtra, PVTGeodetic."""
    return encode_meas_epoch(epoch) + encode_meas_extra(epoch) + encode_pvt(_fix(epoch.time))


def unicore(epoch: Epoch) -> bytes:
    """Return what a Unicore receiver sends with an epoch: OBSVM, BESTNAV."""
    return encode_observations(epoch) + encode_position(_fix(epoch.time))


def _raw_blocks(ephemeris: KeplerEphemeris | GlonassEphemeris) -> list[bytes]:
    """Return the raw navigation blocks of an ephemeris; none where there is no encoder."""
    if isinstance(ephemeris, KeplerEphemeris) and ephemeris.message in _SENT_RAW:
        return encode_navigation(ephemeris, ephemeris.toe)
    return []


def _log_of(ephemeris: KeplerEphemeris | GlonassEphemeris) -> list[bytes]:
    return [encode_ephemeris(ephemeris, ephemeris.toe)]
