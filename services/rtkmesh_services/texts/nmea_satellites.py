"""NMEA 0183 sentences of satellites: GSA and GSV. With ``nmea = "rtklib"`` they are RTKLIB's to the byte."""

from collections.abc import Sequence
from math import isfinite
from typing import Final, NamedTuple

from rtkmesh.gnss.sentences import sentence
from rtkmesh_services.texts.options import TextOptions
from rtkmesh_services.texts.sky import Dops, Satellite, dops

_IN_GSA: Final = 12
_IN_GSV: Final = 4
_RTKLIB_VIEW: Final = 36  # satellites of a system in RTKLIB's GSV
_OLD_VIEW: Final = 12


class _Group(NamedTuple):
    """Systems that share sentences: their RINEX letters, the talker, NMEA's system id, the signal id of 2.4.2's GSV."""

    letters: str
    talker: str
    number: int
    signal: int


_GROUPS: Final = (
    _Group("GS", "GP", 1, 1), _Group("R", "GL", 2, 1), _Group("E", "GA", 3, 7), _Group("C", "GB", 4, 1), _Group("J", "GQ", 5, 1),
    _Group("I", "GI", 6, 1),
)  # fmt: skip
_OLD_GROUPS: Final = _GROUPS[:3]
_OFFSETS: Final = {"S": 13, "R": 64}  # of NMEA's numbers against RINEX's; QZSS has 1 to 10


def gsa(satellites: Sequence[Satellite], solved: bool, options: TextOptions) -> str:
    """Return GSA per system: the satellites in the solution, and DOPs; a second one for more than twelve (RTKLIB leaves them out)."""
    used = [one for one in satellites if one.used]
    if _is_old(options):
        return _old_gsa([one for one in used if one.seen], solved)
    letters, dilutions = {one.id[0] for one in used}, _dilutions(dops(used), options)
    text = ""
    for group in _GROUPS:
        numbers = [_number(one) for one in _of(group, used)]
        talker = "GN" if len(letters) > 1 else group.talker
        last = len(numbers) if options.nmea == "nmea" else min(len(numbers), _IN_GSA)
        for first in range(0, last, _IN_GSA):
            text += _one_gsa(talker, numbers[first : first + _IN_GSA], solved, f"{dilutions},{group.number}")
    return text


def gsv(satellites: Sequence[Satellite], solved: bool, options: TextOptions) -> str:
    """Return GSV per system: the satellites above the horizon."""
    seen = [one for one in satellites if one.seen]
    if _is_old(options):
        return _old_gsv([one for one in seen if one.used], solved, options)
    most = _RTKLIB_VIEW if options.nmea == "rtklib" else len(seen)
    return "".join(_views(group, _of(group, seen)[:most], 0, options) for group in _GROUPS)


def _is_old(options: TextOptions) -> bool:
    return options.nmea == "rtklib" and options.dialect == "2.4"


def _of(group: _Group, satellites: Sequence[Satellite]) -> list[Satellite]:
    """Return the satellites of a group in RTKLIB's order: system by system, by number."""
    return sorted((one for one in satellites if one.id[0] in group.letters), key=lambda one: (group.letters.index(one.id[0]), one.id))


def _number(one: Satellite) -> str:
    return f"{int(one.id[1:]) + _OFFSETS.get(one.id[0], 0):02d}"


def _dilutions(found: Dops, options: TextOptions) -> str:
    """Return PDOP, HDOP and VDOP; RTKLIB writes 0.0 where there are none."""
    none = "" if options.nmea == "nmea" else "0.0"
    return ",".join(f"{value:3.1f}" if isfinite(value) else none for value in found)


def _one_gsa(talker: str, numbers: Sequence[str], solved: bool, rest: str) -> str:
    fields = [*numbers, *[""] * (_IN_GSA - len(numbers))]
    return sentence(f"{talker}GSA,A,{3 if solved else 1},{','.join(fields)},{rest}")


def _views(group: _Group, satellites: Sequence[Satellite], signal: int, options: TextOptions) -> str:
    """Return the GSV sentences of a group; places without a satellite are empty."""
    count, text = -(-len(satellites) // _IN_GSV), ""
    for k in range(count):
        some = [_view(one, options) for one in satellites[k * _IN_GSV : (k + 1) * _IN_GSV]]
        some += [",,,"] * (_IN_GSV - len(some))
        text += sentence(f"{group.talker}GSV,{count},{k + 1},{len(satellites):02d},{','.join(some)},{signal}")
    return text


def _view(one: Satellite, options: TextOptions) -> str:
    azimuth_deg = one.azimuth_deg + 360.0 if one.azimuth_deg < 0.0 else one.azimuth_deg
    azimuth = f"{azimuth_deg:03.0f}"
    if options.nmea == "nmea" and azimuth == "360":
        azimuth = "000"
    cn0 = f"{one.cn0_dbhz:02.0f}" if isfinite(one.cn0_dbhz) else ("" if options.nmea == "nmea" else "00")
    return f"{_number(one)},{one.elevation_deg:02.0f},{azimuth},{cn0}"


def _old_gsa(used: Sequence[Satellite], solved: bool) -> str:
    """Return 2.4.2's GSA: GPS, GLONASS and Galileo, each with its own DOPs."""
    if not solved:
        return sentence("GPGSA,A,1" + "," * 15)
    text = ""
    for group in _OLD_GROUPS:
        satellites = _of(group, used)[:_IN_GSA]
        if satellites:
            dilutions = ",".join(f"{value if isfinite(value) else 0.0:3.1f}" for value in dops(satellites))
            text += _one_gsa(group.talker, [_number(one) for one in satellites], solved, f"{dilutions},{group.number}")
    return text


def _old_gsv(used: Sequence[Satellite], solved: bool, options: TextOptions) -> str:
    """Return 2.4.2's GSV: twelve satellites of GPS, GLONASS and Galileo that are in the solution."""
    if not solved:
        return sentence("GPGSV,1,1,0" + "," * 16)
    return "".join(_views(group, _of(group, used)[:_OLD_VIEW], group.signal, options) for group in _OLD_GROUPS)
