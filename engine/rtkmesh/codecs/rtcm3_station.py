"""RTCM 3 station messages 1005 to 1008, 1033 and 1230 (RTCM 10403.3, 3.5.2, 3.5.10 and 3.5.13), both ways."""

from collections import OrderedDict
from dataclasses import replace
from math import nan, sqrt
from typing import Final, Generic, TypeVar

from rtkmesh.codecs.bits import BitWriter, Coding, Field, Layout
from rtkmesh.gnss.ephemeris import GlonassBias, ReferenceStation

NUMBERS: Final = (1005, 1006, 1007, 1008, 1033, 1230)
SOURCE: Final = "rtcm3"

_MAX_STATIONS: Final = 16
_MIN_RADIUS_M, _MAX_RADIUS_M = 6.2e6, 6.8e6  # deepest sea to low orbit: everything else is junk
_BIAS_SCALE_M: Final = 0.02  # DF423 to DF426
_INVALID_BIAS: Final = -(1 << 15)
_MAX_TEXT: Final = 31  # DF029, DF032, DF227, DF229, DF231

_S = Coding.TWOS_COMPLEMENT
_POSITION: Final = Layout("1005", 152, (
    Field("number", ((0, 12),)), Field("station_id", ((12, 12),)), Field("itrf_year", ((24, 6),)), Field("gps", ((30, 1),)),
    Field("glonass", ((31, 1),)), Field("galileo", ((32, 1),)), Field("non_physical", ((33, 1),)), Field("x_m", ((34, 38),), 1e-4, _S),
    Field("single_oscillator", ((72, 1),)), Field("y_m", ((74, 38),), 1e-4, _S), Field("quarter_cycle", ((112, 2),)),
    Field("z_m", ((114, 38),), 1e-4, _S),
))  # fmt: skip
_HEIGHT_SCALE_M: Final = 1e-4  # DF028


T = TypeVar("T")


class _Newest(Generic[T]):
    """The last value of each of the newest stations, so that a stream of many ids stays bounded."""

    def __init__(self) -> None:
        self._values: OrderedDict[int, T] = OrderedDict()

    def get(self, station_id: int) -> T | None:
        return self._values.get(station_id)

    def put(self, station_id: int, value: T) -> None:
        self._values[station_id] = value
        self._values.move_to_end(station_id)
        if len(self._values) > _MAX_STATIONS:
            self._values.popitem(last=False)


class StationDecoder:
    """Merges what a stream says of its stations; a value comes out when it changed."""

    def __init__(self) -> None:
        self._stations = _Newest[ReferenceStation]()
        self._biases = _Newest[GlonassBias]()
        self._repeated: dict[int, bytes] = {}  # by number: a message that changed nothing, nor does it until another one does

    def decode(self, payload: bytes, number: int) -> ReferenceStation | GlonassBias | str | None:
        """Return what changed, None if nothing did, or the reason of the message's rejection."""
        if self._repeated.get(number) == payload:
            return None
        if len(payload) < 3:
            return "too short"
        changed = self._changed(payload, number)
        if changed is None:
            self._repeated[number] = payload
        elif not isinstance(changed, str):
            self._repeated.clear()
        return changed

    def _changed(self, payload: bytes, number: int) -> ReferenceStation | GlonassBias | str | None:
        station_id = int.from_bytes(payload[1:3], "big") & 0xFFF
        if number == 1230:
            return self._changed_bias(_decode_bias(payload, station_id))
        known = self._stations.get(station_id) or ReferenceStation(station_id, source=SOURCE)
        new = _decode_position(payload, number, known) if number in (1005, 1006) else _decode_descriptors(payload, number, known)
        if isinstance(new, str) or new == self._stations.get(station_id):
            return new if isinstance(new, str) else None
        self._stations.put(station_id, new)
        return new

    def _changed_bias(self, bias: GlonassBias | str) -> GlonassBias | str | None:
        # repr: NaN of a bias that is not sent equals itself
        if isinstance(bias, str) or repr(bias) == repr(self._biases.get(bias.station_id)):
            return bias if isinstance(bias, str) else None
        self._biases.put(bias.station_id, bias)
        return bias


def _decode_position(payload: bytes, number: int, known: ReferenceStation) -> ReferenceStation | str:
    size = 19 if number == 1005 else 21
    if len(payload) < size:
        return "too short"
    values = _POSITION.read(int.from_bytes(payload[:19], "big"))
    position_m = (round(values["x_m"], 4), round(values["y_m"], 4), round(values["z_m"], 4))
    if not _MIN_RADIUS_M < sqrt(sum(x * x for x in position_m)) < _MAX_RADIUS_M:
        return "not on earth"
    height_m = round(int.from_bytes(payload[19:21], "big") * _HEIGHT_SCALE_M, 4) if number == 1006 else known.antenna_height_m
    return replace(known, position_ecef_m=position_m, antenna_height_m=height_m)


def _decode_descriptors(payload: bytes, number: int, known: ReferenceStation) -> ReferenceStation | str:
    """1007: antenna; 1008: and serial number; 1033: and receiver, firmware, receiver's serial number."""
    texts: list[str] = []
    at = 3
    for index in range({1007: 1, 1008: 2, 1033: 5}[number]):
        if at >= len(payload) or at + 1 + payload[at] > len(payload):
            return "too short"
        texts.append(printable(payload[at + 1 : at + 1 + payload[at]]))
        at += 1 + payload[at] + (1 if index == 0 else 0)  # behind the antenna stands the setup id, DF031
    station = replace(known, antenna=texts[0])
    if number == 1007:
        return station
    station = replace(station, antenna_serial=texts[1])
    return replace(station, receiver=f"{texts[2]} {texts[3]}".strip()) if number == 1033 else station


def printable(text: bytes) -> str:
    """Return the printable ASCII characters only: what comes from the wire ends on screens."""
    return "".join(chr(character) for character in text if 32 <= character < 127).strip()


def _decode_bias(payload: bytes, station_id: int) -> GlonassBias | str:
    """1230: DF421 says whether the biases are already applied; DF422 which of 1C, 1P, 2C, 2P follow."""
    if len(payload) < 4:
        return "too short"
    mask, at, biases = payload[3] & 0xF, 4, [nan] * 4
    if len(payload) < 4 + 2 * mask.bit_count():
        return "too short"
    for k in range(4):
        if mask & (8 >> k):
            value = int.from_bytes(payload[at : at + 2], "big", signed=True)
            biases[k] = nan if value == _INVALID_BIAS else round(value * _BIAS_SCALE_M, 2)
            at += 2
    return GlonassBias(station_id, bool(payload[3] >> 7), (biases[0], biases[1], biases[2], biases[3]))


def position_payload(station: ReferenceStation, *, with_height: bool) -> bytes:
    """Return a 1006 (with antenna height) or 1005 of the station's antenna reference point; ValueError if it has no position."""
    if station.position_ecef_m is None:
        raise ValueError(f"station {station.station_id} has no position")
    x, y, z = station.position_ecef_m
    block = _POSITION.write({
        "number": 1006 if with_height else 1005, "station_id": station.station_id, "gps": 1, "glonass": 1, "galileo": 1,
        "x_m": x, "y_m": y, "z_m": z, "single_oscillator": 1,
    }).to_bytes(19, "big")  # fmt: skip
    return block + round(station.antenna_height_m / _HEIGHT_SCALE_M).to_bytes(2, "big") if with_height else block


def descriptor_payload(station: ReferenceStation, number: int = 1033) -> bytes:
    """Return a 1007, 1008 or 1033 of the station; texts are cut to the 31 characters that fit."""
    texts = [station.antenna, station.antenna_serial, station.receiver, "", ""][: {1007: 1, 1008: 2, 1033: 5}[number]]
    out = bytearray((number << 12 | station.station_id).to_bytes(3, "big"))
    for index, text in enumerate(texts):
        characters = text.encode("ascii", "replace")[:_MAX_TEXT]
        out += bytes((len(characters),)) + characters + (b"\0" if index == 0 else b"")
    return bytes(out)


def bias_payload(bias: GlonassBias) -> bytes:
    """Return a 1230 with the biases that are not NaN."""
    writer = BitWriter()
    writer.unsigned(1230, 12)
    writer.unsigned(bias.station_id, 12)
    writer.unsigned(int(bias.aligned), 1)
    writer.unsigned(0, 3)
    sent = [value for value in bias.bias_m if value == value]
    for value in bias.bias_m:
        writer.unsigned(int(value == value), 1)
    for value in sent:
        writer.signed(round(value / _BIAS_SCALE_M), 16)
    return writer.to_bytes()
