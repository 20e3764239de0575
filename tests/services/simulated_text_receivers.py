"""Receivers behind pseudo-terminals that take commands as text, as a UM982 and a mosaic-X5 answer them (from captures of others)."""

import os
import re
import select
import threading
from functools import reduce
from math import radians

from tests.services.simulated_receiver import PLACE, Device

from rtkmesh.codecs.rtcm3_encode import encode_station
from rtkmesh.gnss.ephemeris import ReferenceStation
from rtkmesh.gnss.frames import ecef_from_geodetic


class TextReceiver(Device):
    """Reads lines and answers them. ``refused``: the beginnings of commands that it does not know."""

    def __init__(self, refused: tuple[str, ...] = ()) -> None:
        super().__init__()
        self.heard: list[str] = []
        self.refused = refused
        self.position: tuple[float, float, float] | None = None
        self._rest = b""

    def answer(self, line: str) -> str:
        raise NotImplementedError

    def _run(self) -> None:
        while not self._stop.is_set():
            if select.select([self.master], [], [], 0.05)[0]:
                self._rest += os.read(self.master, 4096)
            elif self.position is not None:
                self._say(encode_station(ReferenceStation(7, self.position))[0])
            else:
                self._say(b"$GNGGA,000000.00,,,,,0,00,99.9,,,,,,*41\r\n\xb5\x00")
            *lines, self._rest = self._rest.split(b"\r\n")
            for line in lines:
                text = line.decode("ascii", "replace")
                if text.isprintable() and text.isascii() and text:  # else: what a u-blox receiver would understand
                    self.heard.append(text)
                    self._say(self.answer(text).encode())


class SimulatedUnicore(TextReceiver):
    """A UM982. Its checksums of command replies include the ``$``, as firmware makes them."""

    def __init__(self, refused: tuple[str, ...] = ()) -> None:
        super().__init__(refused)
        self.mode = "ROVER SURVEY"
        self.settings = {"COM1": "CONFIG COM1 115200"}
        self.logs: dict[str, str] = {}
        self.saved = False

    def answer(self, line: str) -> str:
        if line.startswith(self.refused) and self.refused:
            return xor(f"$command,response: PARSING FAILED NO MATCHING FUNC {line}")
        words = line.split()
        more = ""
        if line == "VERSIONA":
            version = '"UM982","R4.10Build11833","HRPT00-S10C-P","2310415000001","ff3bac96f31f9bdd","2022/09/28"'
            more = f"#VERSIONA,97,GPS,FINE,2343,547392000,0,0,18,873;{version}*7432d4ed\r\n"
        elif line == "MODE":
            more = f"#MODE,97,GPS,FINE,2343,547392000,0,0,18,873;MODE {self.mode},*1B\r\n"
        elif words[0] == "MODE":
            self._set_mode(words[1:])
        elif line == "CONFIG":
            more = "".join(xor(f"$CONFIG,{name},{text}") for name, text in self.settings.items())
        elif words[0] == "CONFIG":
            self.settings[" ".join(words[1:3]) if words[1] == "HEADING" else words[1]] = line
        elif line == "UNILOGLIST":
            rows = "".join(f"{text}\t\r\n" for text in self.logs.values())
            more = f"#UNILOGLIST,92,GPS,FINE,2353,142915000,0,0,18,296;\r\n{len(self.logs)}\r\n{rows}"
        elif words[0] == "UNLOG":
            self.logs.clear()
        elif line == "SAVECONFIG":
            self.saved = True
        else:
            self.logs[words[0]] = line
        return xor(f"$command,{line},response: OK") + more

    def _set_mode(self, words: list[str]) -> None:
        self.mode = " ".join(words)
        if words[:2] == ["BASE", "TIME"]:
            threading.Timer(float(words[2]), self._surveyed).start()
        elif words[0] == "BASE":
            x, y, z = map(float, words[1:])
            self.position = (x, y, z)
        else:
            self.position = None

    def _surveyed(self) -> None:
        self.position = PLACE


class SimulatedMosaic(TextReceiver):
    """A mosaic-X5: it repeats commands, and tells the settings of the group below."""

    def __init__(self, refused: tuple[str, ...] = ()) -> None:
        super().__init__(refused)
        self.settings: dict[str, str] = {}

    def answer(self, line: str) -> str:
        if line == "S" * 10:
            return "COM1>"
        parts = [part.strip() for part in line.split(",")]
        if line.startswith(self.refused) and self.refused:
            return f"$R? {parts[0]}: Argument '{parts[-1]}' is invalid!\r\nCOM1>"
        if parts[0] == "lstInternalFile":
            return f'$R; {line}\r\n---->\r\n$-- BLOCK 1 / 1\r\n<?xml version="1.0"?>\r\n<hwplatform product="mosaic-X5"/>\r\nCOM1>'
        match = re.fullmatch(r"(set|get|exe)(\w+)", parts[0])
        assert match is not None, line
        name = match[2]
        group = f"{name} {parts[1]}" if len(parts) > 1 and name != "PVTMode" else name
        if name == "PVTMode" and match[1] == "set":
            self._set_mode(parts[1:])
        if match[1] == "set":
            self.settings[group] = ", ".join([name, *parts[1:]])
        return f"$R: {line}\r\n  {self.settings.get(group, name)}\r\nCOM1>"

    def _set_mode(self, parts: list[str]) -> None:
        told = self.settings.get("StaticPosGeodetic Geodetic1", "").split(", ")[2:5]
        self.position = None
        if parts[0] == "Static" and parts[-1] == "auto":
            self.position = PLACE
        elif parts[0] == "Static" and told:
            lat_deg, lon_deg, height_m = map(float, told)
            x, y, z = ecef_from_geodetic(radians(lat_deg), radians(lon_deg), height_m).tolist()
            self.position = (x, y, z)


def xor(text: str) -> str:
    """Return a line with the checksum that the firmware makes."""
    return f"{text}*{reduce(lambda a, b: a ^ b, text.encode()):02X}\r\n"
