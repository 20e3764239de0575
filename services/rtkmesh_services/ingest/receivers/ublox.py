"""u-blox: configuration by keys (generation 9 and later) or by messages (before), with ACK; the survey's progress.

u-blox F9 HPG 1.32 interface description: 3.9 (ACK), 3.10 (CFG), 3.15.25 (NAV-SVIN), 4.9.28 (CFG-TMODE).
"""

import struct
from collections.abc import Mapping, Sequence
from typing import Final

from rtkmesh.codecs.messages import Frame, Protocol
from rtkmesh.codecs.ubx_receiver import READERS, read_report
from rtkmesh.gnss.receiver import CommandAnswer, ReceiverReport, SurveyIn
from rtkmesh_services.errors import SourceError
from rtkmesh_services.ingest.receivers.orders import Answer, Heard, Order
from rtkmesh_services.ingest.receivers.survey import Position
from rtkmesh_services.ingest.ubx_commands import framed, key_of, type_of_key, ubx_frame

VALGET, MON_VER = "06-8b", "0a-04"
RAM, BBR, FLASH = 1, 2, 4
MAXIMUM_KEYS: Final = 64  # of one CFG-VALSET or -VALGET


def payload_of(frame: Frame) -> bytes:
    """Return the payload of a UBX frame."""
    return frame.data[6:-2]


def report_of(heard: Heard) -> ReceiverReport | None:
    """Return what a UBX frame says of the receiver itself, None where it says nothing of that, or too little."""
    if isinstance(heard, str) or heard.protocol is not Protocol.UBX or heard.kind not in READERS:
        return None
    found = read_report(heard.kind, payload_of(heard), None)
    return None if isinstance(found, str) else found


def verdict_on(heard: Heard, data: bytes) -> Answer | None:
    """Return the ACK-ACK or ACK-NAK of a configuration frame, None for anything else."""
    report = report_of(heard)
    if not isinstance(report, CommandAnswer) or report.command != f"ubx {data[2]:02x}-{data[3]:02x}":
        return None
    return Answer(report.accepted, report.text)


def acknowledged(said: str, data: bytes) -> Order:
    """Return the order of a configuration frame: taken when ACK-ACK names its class and id, refused with ACK-NAK."""
    return Order(said, data, lambda heard: verdict_on(heard, data))


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
        verdict = verdict_on(heard, data)
        if verdict is not None and not verdict.accepted:
            return verdict
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

    return Order(said, framed(class_, number, b""), judge, needed=False, attempts=3)


def centimetres(value_m: float) -> tuple[int, int]:
    """Return whole centimetres and tenths of a millimetre, both with the sign of the value."""
    whole, rest = divmod(abs(round(value_m * 1e4)), 100)
    return (whole, rest) if value_m >= 0.0 else (-whole, -rest)


def progress_of(heard: Heard) -> SurveyIn | None:
    """Return what a NAV-SVIN says, None for anything else."""
    report = report_of(heard)
    return report if isinstance(report, SurveyIn) else None


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

    def progress(self, heard: Heard) -> SurveyIn | None:
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
