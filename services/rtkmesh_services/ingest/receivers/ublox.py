"""u-blox: configuration by keys (generation 9 and later) or by messages (before), with ACK; the survey's progress.

u-blox F9 HPG 1.32 interface description: 3.9 (ACK), 3.10 (CFG), 3.15.25 (NAV-SVIN), 4.9.28 (CFG-TMODE).
"""

import struct
from collections.abc import Mapping, Sequence
from struct import Struct
from typing import Final

from rtkmesh.codecs.messages import Frame
from rtkmesh_services.errors import SourceError
from rtkmesh_services.ingest.receivers.orders import Answer, Heard, Order
from rtkmesh_services.ingest.receivers.survey import Position, SurveyProgress
from rtkmesh_services.ingest.ubx_commands import framed, key_of, type_of_key, ubx_frame

ACK, NAK, SVIN, VALGET, MON_VER = "05-01", "05-00", "01-3b", "06-8b", "0a-04"
RAM, BBR, FLASH = 1, 2, 4
MAXIMUM_KEYS: Final = 64  # of one CFG-VALSET or -VALGET
_SVIN: Final = Struct("<B3xIIiiibbbxIIBB2x")
_SVIN_PAYLOAD: Final = 40


def payload_of(frame: Frame) -> bytes:
    """Return the payload of a UBX frame."""
    return frame.data[6:-2]


def acknowledged(said: str, data: bytes) -> Order:
    """Return the order of a configuration frame: taken when ACK-ACK names its class and id, refused with ACK-NAK."""
    about = data[2:4]

    def judge(heard: Heard) -> Answer | None:
        if isinstance(heard, str) or heard.kind not in (ACK, NAK) or payload_of(heard)[:2] != about:
            return None
        return Answer(heard.kind == ACK, "ACK-ACK" if heard.kind == ACK else "ACK-NAK")

    return Order(said, data, judge)


def valset(values: Mapping[str, float], layers: int = RAM) -> Order:
    """Return the order that sets keys in layers (a sum of RAM, BBR, FLASH); SourceError for a key that is none."""
    words = " ".join(f"{key} {value}" for key, value in values.items())
    return acknowledged("CFG-VALSET", ubx_frame(f"CFG-VALSET 0 {layers} 0 0 {words}"))


def valget(keys: Sequence[str]) -> Order:
    """Return the order that reads keys in RAM; its answer has their values by the names given."""
    names = {key_of(key)[0]: key for key in keys}
    data = ubx_frame(f"CFG-VALGET 0 0 0 {' '.join(keys)}")

    def judge(heard: Heard) -> Answer | None:
        if isinstance(heard, str):
            return None
        if heard.kind == NAK and payload_of(heard)[:2] == data[2:4]:
            return Answer(accepted=False, text="ACK-NAK")
        if heard.kind != VALGET or payload_of(heard)[:1] != b"\x01":
            return None
        found = {names[number]: value for number, value in _values(payload_of(heard)[4:]).items() if number in names}
        return Answer(accepted=True, text="", values=found) if found else None

    return Order("CFG-VALGET", data, judge)


def _values(data: bytes) -> dict[int, float]:
    """Return the values in a CFG-VALGET by number of the key; what is cut short is left out."""
    found: dict[int, float] = {}
    at = 0
    while at + 4 <= len(data):
        number = int.from_bytes(data[at : at + 4], "little")
        letter = type_of_key(number)
        size = struct.calcsize(letter) if letter else 0
        if not letter or at + 4 + size > len(data):
            break
        found[number] = struct.unpack_from(f"<{letter}", data, at + 4)[0]
        at += 4 + size
    return found


def poll(class_: int, number: int, said: str) -> Order:
    """Return the order that asks for a message; its answer is the message."""
    kind = f"{class_:02x}-{number:02x}"

    def judge(heard: Heard) -> Answer | None:
        return Answer(accepted=True, text=said) if isinstance(heard, Frame) and heard.kind == kind else None

    return Order(said, framed(class_, number, b""), judge, needed=False, attempts=2)


def centimetres(value_m: float) -> tuple[int, int]:
    """Return whole centimetres and tenths of a millimetre, both with the sign of the value."""
    whole, rest = divmod(abs(round(value_m * 1e4)), 100)
    return (whole, rest) if value_m >= 0.0 else (-whole, -rest)


def progress_of(heard: Heard) -> SurveyProgress | None:
    """Return what a NAV-SVIN says, None for anything else."""
    if isinstance(heard, str) or heard.kind != SVIN or len(payload_of(heard)) < _SVIN_PAYLOAD:
        return None
    _, _, duration_s, x, y, z, x_hp, y_hp, z_hp, accuracy, observations, valid, active = _SVIN.unpack_from(heard.data, 6)
    position = (x * 1e-2 + x_hp * 1e-4, y * 1e-2 + y_hp * 1e-4, z * 1e-2 + z_hp * 1e-4)
    return SurveyProgress(
        duration_s=float(duration_s),
        observations=observations,
        position_ecef_m=position if any((x, y, z)) else None,
        accuracy_m=accuracy * 1e-4,
        valid=bool(valid),
        active=bool(active),
    )


class Ublox:
    """Generation 9 and later: keys."""

    name = "ublox"
    tells_progress = True

    def survey(self, minimum_s: float, accuracy_m: float) -> list[Order]:
        """Return the orders of a new survey: the mode is left first, or a running survey would go on."""
        told = {
            "CFG-TMODE-MODE": 1,
            "CFG-TMODE-SVIN_MIN_DUR": round(minimum_s),
            "CFG-TMODE-SVIN_ACC_LIMIT": round(accuracy_m * 1e4),
            **{f"CFG-MSGOUT-UBX_NAV_SVIN_{port}": 1 for port in ("USB", "UART1")},
        }
        return [valset({"CFG-TMODE-MODE": 0}), valset(told)]

    def fixed(self, position_ecef_m: Position, accuracy_m: float) -> list[Order]:
        """Return the orders that tell the position."""
        told = {"CFG-TMODE-MODE": 2, "CFG-TMODE-POS_TYPE": 0}
        for axis, value_m in zip("XYZ", position_ecef_m, strict=True):
            told[f"CFG-TMODE-ECEF_{axis}"], told[f"CFG-TMODE-ECEF_{axis}_HP"] = centimetres(value_m)
        return [valset({**told, "CFG-TMODE-FIXED_POS_ACC": max(1, round(accuracy_m * 1e4))})]

    def rover(self) -> list[Order]:
        """Return the orders that make it a rover again."""
        return [valset({"CFG-TMODE-MODE": 0})]

    def ask(self) -> list[Order]:
        """Return the orders that ask how the survey goes."""
        return [poll(0x01, 0x3B, "NAV-SVIN")]

    def progress(self, heard: Heard) -> SurveyProgress | None:
        """Return what was said of a survey."""
        return progress_of(heard)


class UbloxLegacy(Ublox):
    """Generation 8 (M8P): messages."""

    name = "ublox-legacy"

    def survey(self, minimum_s: float, accuracy_m: float) -> list[Order]:
        """Return the orders of a new survey."""
        limit = f"{round(minimum_s)} {round(accuracy_m * 1e4)}"
        return [*self.rover(), _message("CFG-MSG 0x01 0x3b 0 1 0 1 0 0"), _message(f"CFG-TMODE3 0 0 1 0 0 0 0 0 0 0 0 {limit}")]

    def fixed(self, position_ecef_m: Position, accuracy_m: float) -> list[Order]:
        """Return the orders that tell the position."""
        parts = [centimetres(value_m) for value_m in position_ecef_m]
        numbers = " ".join(str(part[index]) for index in (0, 1) for part in parts)
        return [_message(f"CFG-TMODE3 0 0 2 {numbers} 0 {max(1, round(accuracy_m * 1e4))} 0 0")]

    def rover(self) -> list[Order]:
        """Return the orders that make it a rover again."""
        return [_message("CFG-TMODE3 0 0 0")]


def _message(text: str) -> Order:
    try:
        return acknowledged(text.split(maxsplit=1)[0], ubx_frame(text))
    except SourceError as error:
        raise SourceError(f"{text}: {error}") from None
