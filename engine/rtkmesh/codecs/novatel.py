"""NovAtel OEM4 to OEM7 receivers: observations of either antenna, ephemerides, their own positions and headings (OEM7 manual v15C).

RANGE and RANGECMP, RAWEPHEM, GPSEPHEM, GLOEPHEMERIS, GALEPHEMERIS, GALINAVEPHEMERIS, GALFNAVEPHEMERIS, BDSEPHEMERIS, QZSSRAWEPHEM,
QZSSEPHEMERIS, IONUTC, BESTPOS, HEADING and HEADING2, VERSION; binary and ASCII. All other logs are counted as ignored.
"""

from math import isfinite
from typing import Final

import numpy as np

from rtkmesh.codecs.log_decoder import MAIN_ANTENNA, Found, LogDecoder, fix_of, heading_of, number
from rtkmesh.codecs.messages import Frame, Protocol
from rtkmesh.codecs.novatel_ephemeris import NOVATEL_READERS, RAW, read_raw_ephemeris
from rtkmesh.codecs.novatel_logs import open_novatel_log
from rtkmesh.codecs.novatel_signals import SIGNAL_OF
from rtkmesh.codecs.unicore_ephemeris import read_ephemeris
from rtkmesh.codecs.unicore_logs import Fields, Log
from rtkmesh.codecs.unicore_observations import Form, Units
from rtkmesh.gnss.ephemeris import KlobucharParameters
from rtkmesh.gnss.receiver import ReceiverVersion

RANGE = np.dtype([
    ("prn", "<u2"), ("frequency", "<u2"), ("pseudorange_m", "<f8"), ("pseudorange_sigma", "<f4"), ("range_cyc", "<f8"),
    ("phase_sigma", "<f4"), ("doppler_hz", "<f4"), ("cn0", "<f4"), ("lock_s", "<f4"), ("status", "<u4"),
])  # fmt: skip
NOVATEL: Final = Form(RANGE, Units(1.0, 1.0, 1.0), SIGNAL_OF, tells_parity=True)

# Position type to ReceiverFix.fix; types that are not here are no fix.
_FIX_OF_TYPE: Final = {
    1: 3, 16: 3, 17: 4, 18: 4, 19: 1, 32: 5, 33: 5, 34: 5, 48: 6, 49: 6, 50: 6, 51: 6, 52: 4, 53: 3, 54: 4, 55: 5, 56: 6, 68: 4, 69: 4,
    73: 4, 74: 4, 77: 4, 78: 4, 79: 4, 80: 4,
}  # fmt: skip
BESTPOS: Final = Fields("IIdddfIfff4sffBBBBBBBB")
HEADING: Final = Fields("IIffffff4sBBBBBBBB")
HEADING2: Final = Fields("IIffffff4s4sBBBBBBBB")
IONOSPHERE: Final = Fields("dddddddd")  # the beginning of IONUTC; UTC parameters follow
VERSION: Final = Fields("II16s16s16s16s16s12s12s")  # the first component
_HEADINGS: Final = {"HEADING": (HEADING, 10), "HEADING2": (HEADING2, 11)}  # fields, place of the satellites used


class NovatelDecoder(LogDecoder):
    """Decodes the logs of one antenna of a receiver; ``antenna`` 2 is the second one of an OEM7720. It remembers lock times."""

    def __init__(self, antenna: int = MAIN_ANTENNA) -> None:
        super().__init__(Protocol.NOVATEL)
        suffix = "" if antenna == MAIN_ANTENNA else f"_{antenna - MAIN_ANTENNA}"
        self._full, self._compressed, self._position = f"RANGE{suffix}", f"RANGECMP{suffix}", f"BESTPOS{suffix}"

    def _open(self, frame: Frame) -> Log | None:
        return open_novatel_log(frame)

    def _read(self, log: Log) -> Found | None:
        if log.name in (self._full, self._compressed):
            return self._observations(log, NOVATEL, compressed=log.name == self._compressed)
        if log.name in RAW:
            return read_raw_ephemeris(log)
        if log.name in NOVATEL_READERS:
            return read_ephemeris(log, NOVATEL_READERS)
        if log.name == self._position:
            values = BESTPOS.read(log)
            return "length" if values is None else [fix_of(log, values, _FIX_OF_TYPE, None)]
        return _other(log)


def _other(log: Log) -> Found | None:
    if log.name in _HEADINGS:
        fields, used = _HEADINGS[log.name]
        values = fields.read(log)
        return "length" if values is None else [heading_of(log, values, values[used])]
    if log.name == "IONUTC":
        return _ionosphere(log)
    return _version(log) if log.name == "VERSION" else None


def _ionosphere(log: Log) -> Found:
    values = IONOSPHERE.read(log)
    if values is None:
        return "length"
    a0, a1, a2, a3, b0, b1, b2, b3 = (number(value) for value in values)
    if not all(isfinite(value) for value in (a0, a1, a2, a3, b0, b1, b2, b3)):
        return "value"
    return [KlobucharParameters("G", (a0, a1, a2, a3), (b0, b1, b2, b3))]


def _version(log: Log) -> Found:
    values = VERSION.read(log)
    if values is None:
        return "length"
    _, _, options, _, hardware, software, boot, _, _ = (str(value) for value in values)
    return [ReceiverVersion(hardware, software, "", (options, boot))]
