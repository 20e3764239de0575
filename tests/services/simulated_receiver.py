"""A receiver behind a pseudo-terminal that speaks u-blox's language as a ZED-F9P does: made with pyubx2, not with our own encoders.

It acknowledges, keeps its configuration by layers, surveys in, sends NAV-PVT, NAV-SVIN and 1005, says with RXM-RTCM what it thinks of
each correction, and reads no faster than its line carries. Its seconds may be shorter than ours (``second_s``).
"""

import os
import pty
import select
import struct
import threading
import time
import tty
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from math import degrees, sqrt
from typing import TypeVar

import numpy as np
from pyubx2 import GET, UBX_CONFIG_DATABASE, UBXMessage

from rtkmesh.codecs.framing import Framer
from rtkmesh.codecs.messages import Frame, Protocol
from rtkmesh.codecs.rtcm3_encode import encode_station
from rtkmesh.gnss.ephemeris import ReferenceStation
from rtkmesh.gnss.frames import geodetic_from_ecef

Position = tuple[float, float, float]
PLACE: Position = (4268987.1234, 1178894.4567, 4574798.7891)
_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8}
_NUMBERS = {number for number, _ in UBX_CONFIG_DATABASE.values()}


def key(name: str) -> int:
    """Return the number of a configuration key."""
    return UBX_CONFIG_DATABASE[name][0]


class Device:
    """The receiver's end of a pseudo-terminal, and a thread that serves it."""

    def __init__(self) -> None:
        self.master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()
        for end in (self.master, self._slave):
            os.close(end)

    def _run(self) -> None:
        raise NotImplementedError

    def _say(self, data: bytes) -> None:
        with suppress(OSError):
            if data and select.select([], [self.master], [], 0.0)[1]:
                os.write(self.master, data)


Kind = TypeVar("Kind", bound=Device)


@dataclass
class SimulatedReceiver(Device):
    """``deaf``: so many configuration messages go by without a word; ``refused``: keys it does not have."""

    place: Position = PLACE
    second_s: float = 0.02
    bytes_per_s: float = 0.0
    deaf: int = 0
    refused: frozenset[str] = frozenset()
    stubborn: frozenset[str] = frozenset()  # keys that it acknowledges and does not change
    used: int = 2
    bias_m: float = 0.0  # east of the true place: what its fixes and surveys are off
    ram: dict[int, int] = field(default_factory=dict[int, int])
    flash: dict[int, int] = field(default_factory=dict[int, int])
    corrections: list[Frame] = field(default_factory=list[Frame])
    heard: Counter[str] = field(default_factory=Counter[str])
    model: str = "ZED-F9P"
    messages: dict[bytes, bytes] = field(default_factory=dict[bytes, bytes])  # of generation 8: payloads by what polls them

    def __post_init__(self) -> None:
        super().__init__()
        self._framer = Framer()
        self._framer.feed(b"\n")  # compiles or loads its kernel
        self._duration = 0
        self._lock = threading.Lock()

    def power_cycle(self) -> None:
        """Forget what is not in flash."""
        with self._lock:
            self.ram = dict(self.flash)
            self._duration = 0

    def value(self, name: str) -> int:
        return self.ram.get(key(name), 0)

    @property
    def mode(self) -> int:
        return self.value("CFG_TMODE_MODE")

    @property
    def valid(self) -> bool:
        return self.mode == 1 and self._duration >= self.value("CFG_TMODE_SVIN_MIN_DUR") and self._accuracy() <= self._limit()

    def position(self) -> Position:
        """Return the position that it surveys, or was told."""
        if self.mode == 2:
            axes = [(self.value(f"CFG_TMODE_ECEF_{axis}"), self.value(f"CFG_TMODE_ECEF_{axis}_HP")) for axis in "XYZ"]
            x, y, z = (signed(whole, 32) * 1e-2 + signed(rest, 8) * 1e-4 for whole, rest in axes)
            return x, y, z
        east = np.array([-self.place[1], self.place[0], 0.0]) / sqrt(self.place[0] ** 2 + self.place[1] ** 2)
        x, y, z = (np.array(self.place) + self.bias_m * east).tolist()
        return x, y, z

    def _limit(self) -> float:
        return self.value("CFG_TMODE_SVIN_ACC_LIMIT") * 1e-4

    def _accuracy(self) -> float:
        return 5.0 / sqrt(max(1, self._duration))

    def _run(self) -> None:
        next_s, read_s = time.monotonic() + self.second_s, time.monotonic()
        while not self._stop.is_set():
            now_s = time.monotonic()
            room = 4096 if not self.bytes_per_s else int((now_s - read_s) * self.bytes_per_s)
            if room > 0 and select.select([self.master], [], [], 0.002)[0]:
                with suppress(OSError):
                    self._hear(os.read(self.master, room))
            if room > 0:
                read_s = now_s
            else:
                time.sleep(0.002)  # the line carries no more
            if now_s >= next_s:
                next_s += self.second_s
                self._second()

    def _second(self) -> None:
        with self._lock:
            self._duration += 1
            out = self._fix()
            if self.value("CFG_MSGOUT_UBX_NAV_SVIN_USB") or self.value("CFG_MSGOUT_UBX_NAV_SVIN_UART1"):
                out += self._svin()
            if self.mode == 2 or self.valid:
                out += encode_station(ReferenceStation(7, self.position()))[0]
        self._say(out)

    def _fix(self) -> bytes:
        lat_rad, lon_rad, height_m = geodetic_from_ecef(np.array(self.position())).tolist()
        second = self._duration % 60
        return UBXMessage(
            "NAV", "NAV-PVT", GET, iTOW=345600000 + 1000 * self._duration, year=2026, month=1, day=1, hour=0, min=0, second=second,
            validDate=1, validTime=1, fullyResolved=1, fixType=5 if self.mode == 2 or self.valid else 3, gnssFixOk=1, numSV=12,
            lat=degrees(lat_rad), lon=degrees(lon_rad), height=round(height_m * 1e3), hAcc=800, vAcc=1500,
        ).serialize()  # fmt: skip

    def _svin(self) -> bytes:
        surveys = self.mode == 1
        parts = [(*divmod(abs(round(value * 1e4)), 100), 1 if value >= 0.0 else -1) for value in self.position()]
        (x, xh, sx), (y, yh, sy), (z, zh, sz) = parts if surveys else [(0, 0, 1)] * 3
        return UBXMessage(
            "NAV", "NAV-SVIN", GET, dur=self._duration if surveys else 0, meanX=sx * x, meanY=sy * y, meanZ=sz * z, meanXHP=sx * xh,
            meanYHP=sy * yh, meanZHP=sz * zh, meanAcc=round(self._accuracy() * 1e4) if surveys else 0, obs=self._duration if surveys else 0,
            valid=int(self.valid), active=int(surveys and not self.valid),
        ).serialize()  # fmt: skip

    def _hear(self, data: bytes) -> None:
        for frame in self._framer.feed(data):
            with self._lock:
                self.heard[f"{frame.protocol}/{frame.kind}"] += 1
                out = self._answer(frame)
            self._say(out)

    def _answer(self, frame: Frame) -> bytes:
        if frame.protocol is Protocol.RTCM3:
            self.corrections.append(frame)
            number = int(frame.kind)
            return UBXMessage("RXM", "RXM-RTCM", GET, version=2, crcFailed=0, msgUsed=self.used, refStation=7, msgType=number).serialize()
        payload = frame.data[6:-2]
        if frame.kind == "0a-04":
            texts = b"EXT CORE 1.00 (f10c36)".ljust(30, b"\0") + b"00190000".ljust(10, b"\0")
            protocol = "PROTVER=22.00" if "M8" in self.model else "PROTVER=27.31"
            texts += b"".join(text.encode().ljust(30, b"\0") for text in ("ROM BASE 0x118B2060", protocol, f"MOD={self.model}"))
            return UBXMessage("MON", "MON-VER", GET, payload=texts).serialize()
        if frame.kind == "01-3b":
            return self._svin()
        if frame.kind not in ("06-8a", "06-8b"):
            return self._message(frame, payload) if frame.kind.startswith("06-") else b""
        if self.deaf > 0:
            self.deaf -= 1
            return b""
        return self._set(frame, payload) if frame.kind == "06-8a" else self._get(frame, payload)

    def _message(self, frame: Frame, payload: bytes) -> bytes:
        """Take a message of generation 8: CFG-RATE, -MSG and -CFG, or a poll of them."""
        asked = {"06-08": 0, "06-01": 2, "06-09": 99}.get(frame.kind)
        if asked is None or "M8T" not in self.model:
            return acknowledgement(frame, taken=False)
        about = frame.data[2:4] + payload[:asked]
        if len(payload) == asked:
            return UBXMessage(frame.data[2:3], frame.data[3:4], GET, payload=self.messages[about]).serialize() + acknowledgement(
                frame, taken=True
            )
        self.messages[about] = payload
        return acknowledgement(frame, taken=True)

    def _set(self, frame: Frame, payload: bytes) -> bytes:
        values: dict[int, int] = {}
        at = 4
        while at < len(payload):
            number = int.from_bytes(payload[at : at + 4], "little")
            size = _SIZES[number >> 28 & 7]
            values[number] = int.from_bytes(payload[at + 4 : at + 4 + size], "little")
            at += 4 + size
        if self._unknown(values):
            return acknowledgement(frame, taken=False)
        if payload[1] & 1:
            if values.get(key("CFG_TMODE_MODE"), self.mode) != self.mode:
                self._duration = 0
            self.ram.update({number: value for number, value in values.items() if number not in map(key, self.stubborn)})
        if payload[1] & 4:
            self.flash.update(values)
        return acknowledgement(frame, taken=True)

    def _get(self, frame: Frame, payload: bytes) -> bytes:
        numbers = [number for (number,) in struct.iter_unpack("<I", payload[4:])]
        if self._unknown(numbers):
            return acknowledgement(frame, taken=False)
        pairs = [number.to_bytes(4, "little") + self.ram.get(number, 0).to_bytes(_SIZES[number >> 28 & 7], "little") for number in numbers]
        return UBXMessage("CFG", "CFG-VALGET", GET, payload=b"\x01\0\0\0" + b"".join(pairs)).serialize() + acknowledgement(
            frame, taken=True
        )

    def _unknown(self, numbers: object) -> bool:
        refused = {key(name) for name in self.refused}
        return any(number not in _NUMBERS or number in refused for number in numbers)  # type: ignore[attr-defined]


def signed(value: int, bits: int) -> int:
    return value - (1 << bits) if value >> (bits - 1) else value


def acknowledgement(frame: Frame, *, taken: bool) -> bytes:
    name = "ACK-ACK" if taken else "ACK-NAK"
    return UBXMessage("ACK", name, GET, clsID=frame.data[2], msgID=frame.data[3]).serialize()


@contextmanager
def running(receiver: Kind) -> Iterator[Kind]:
    """Give a receiver that runs."""
    receiver.start()
    try:
        yield receiver
    finally:
        receiver.stop()
