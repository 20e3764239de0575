"""ANTEX 1.4 (Rothacher, Schmid 2010): calibrations of receiver antennas, both ways. Satellite antennas and RMS values are passed over."""

import re
from collections.abc import Iterable, Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.codecs.rinex_header import as_bytes, integer, number, numbers
from rtkmesh.errors import FormatError
from rtkmesh.gnss.antenna import NO_RADOME, AntennaCalibration, BandCalibration

_LABEL: Final = 60  # column of the label
_FIELD: Final = 8  # F8.1 and F8.2
_MAX_FIELDS: Final = 361
_M_PER_MM: Final = 1e-3
_SATELLITE: Final = re.compile(r"[GRECJSI]\d\d\s*$")
_KIND: Final = re.compile(rb"(?m)^(.)[^\n]{59}PCV TYPE / REFANT")


class AntexFile:
    """The receiver antennas of an ANTEX file: an index of their names; a calibration is decoded when it is asked for.

    FormatError if the text is no ANTEX file or holds calibrations relative to a reference antenna.
    """

    def __init__(self, text: str | bytes) -> None:
        self._text = as_bytes(text)
        if self._text[_LABEL : _LABEL + 20] != b"ANTEX VERSION / SYST":
            raise FormatError("the first line has no label 'ANTEX VERSION / SYST'")
        kind = _KIND.search(self._text)
        if kind is None or kind[1] != b"A":
            raise FormatError("only absolute calibrations (PCV TYPE 'A') can be used")
        self._blocks: dict[tuple[str, str], dict[str, tuple[int, int]]] = {}
        for begin, end, name in _blocks(self._text):
            if _SATELLITE.match(name[20:40]) is None:
                self._blocks.setdefault(_type_and_radome(name), {})[name[20:40].strip()] = begin, end

    def __iter__(self) -> Iterator[AntennaCalibration]:
        for blocks in self._blocks.values():
            yield from (self._decode(*block) for block in blocks.values())

    @property
    def names(self) -> tuple[tuple[str, str], ...]:
        """Antenna types with their radomes, in the order of the file."""
        return tuple(self._blocks)

    def find(self, antenna: str, radome: str, serial: str = "") -> AntennaCalibration | None:
        """Return the calibration of an antenna with this radome, None if there is none; FormatError if it is damaged.

        That of the antenna with this serial number if there is one, else the type's, else the only individual one.
        """
        blocks = self._blocks.get((antenna, radome), {})
        block = blocks.get(serial) or blocks.get("") or (next(iter(blocks.values())) if len(blocks) == 1 else None)
        return None if block is None else self._decode(*block)

    def _decode(self, begin: int, end: int) -> AntennaCalibration:
        return _calibration(self._text[begin:end].decode("latin-1").splitlines())


def _blocks(text: bytes) -> Iterator[tuple[int, int, str]]:
    """Yield begin, end and the name line (type, radome, serial) of each antenna."""
    begin = 0
    while (begin := text.find(b"START OF ANTENNA", begin)) >= 0:
        end = text.find(b"END OF ANTENNA", begin)
        label = text.find(b"TYPE / SERIAL NO", begin, end)
        if end < 0 or label < 0:
            raise FormatError("an antenna has no name or no end")
        start = text.rfind(b"\n", begin, label) + 1
        yield begin, end, text[start:label].decode("latin-1")
        begin = end


def _type_and_radome(name: str) -> tuple[str, str]:
    return name[:16].strip().upper(), name[16:20].strip().upper() or NO_RADOME


def _content(lines: list[str], label: str) -> str:
    found = next((line for line in lines if line[_LABEL:].startswith(label)), None)
    if found is None:
        raise FormatError(f"an antenna has no line {label!r}")
    return found[:_LABEL]


def _calibration(lines: list[str]) -> AntennaCalibration:
    name = _content(lines, "TYPE / SERIAL NO")
    try:
        azimuth_step_deg = number(_content(lines, "DAZI")[2:8])
        first_deg, last_deg, zenith_step_deg = list(numbers(_content(lines, "ZEN1 / ZEN2 / DZEN")[2:20], 6))
        zeniths = _fields(last_deg, zenith_step_deg)
        if first_deg != 0.0 or zeniths < 2:
            raise FormatError(f"zenith angles {first_deg:g} to {last_deg:g} by {zenith_step_deg:g}")
        azimuths = _fields(360.0, azimuth_step_deg) if azimuth_step_deg else 1
        bands = tuple(_band(section, azimuths, zeniths) for section in _sections(lines))
        if not bands or len(bands) != integer(_content(lines, "# OF FREQUENCIES")[:6]):
            raise FormatError(f"{len(bands)} frequencies, not as many as it says")
    except FormatError as error:
        raise FormatError(f"antenna {name[:20].strip()}: {error}") from None
    antenna, radome = _type_and_radome(name)
    return AntennaCalibration(antenna, radome, name[20:40].strip(), zenith_step_deg, azimuth_step_deg, bands)


def _fields(last_deg: float, step_deg: float) -> int:
    """Return how many grid lines there are from 0 to ``last_deg``."""
    count = round(last_deg / step_deg) + 1 if step_deg > 0.0 else 0
    if not 1 <= count <= _MAX_FIELDS or abs((count - 1) * step_deg - last_deg) > 1e-6:
        raise FormatError(f"a grid to {last_deg:g} degrees by {step_deg:g}")
    return count


def _sections(lines: list[str]) -> Iterator[list[str]]:
    """Yield the lines of each frequency, its first line with it."""
    begin = None
    for index, line in enumerate(lines):
        label = line[_LABEL:].rstrip()
        if label == "START OF FREQUENCY":
            begin = index
        elif label == "END OF FREQUENCY" and begin is not None:
            yield lines[begin:index]
            begin = None


def _band(section: list[str], azimuths: int, zeniths: int) -> BandCalibration:
    frequency = section[0][3:6]
    north_mm, east_mm, up_mm = _values([_content(section, "NORTH / EAST / UP")[:30]], 3, 10)[0]
    rows = [line for line in section[1:] if not line[_LABEL:].startswith(("NORTH / EAST / UP", "COMMENT"))]
    mean = [line[_FIELD:] for line in rows if line[:_FIELD].strip() == "NOAZI"]
    by_azimuth = [line[_FIELD:] for line in rows if line[:_FIELD].strip() != "NOAZI"]
    used = by_azimuth if azimuths > 1 else mean
    if len(mean) != 1 or len(used) != azimuths:
        raise FormatError(f"{frequency} has {len(used)} rows of {azimuths}")
    variation_m = _values(used, zeniths, _FIELD) * _M_PER_MM
    return BandCalibration(frequency, (east_mm * _M_PER_MM, north_mm * _M_PER_MM, up_mm * _M_PER_MM), variation_m)


def _values(rows: list[str], count: int, width: int) -> NDArray[np.float64]:
    """Return the numbers of rows of ``count`` fixed fields."""
    fields = np.array([row[k * width : (k + 1) * width] for row in rows for k in range(count)])
    try:
        values = fields.astype(np.float64).reshape(len(rows), count)
    except ValueError as error:
        raise FormatError(f"a value is no number: {error}") from None
    if not np.isfinite(values).all():
        raise FormatError("a value is not finite")
    return values


def write_antex(calibrations: Iterable[AntennaCalibration], comments: Iterable[str] = ()) -> str:
    """Return an ANTEX 1.4 file with these calibrations, lines of fixed columns; comments are cut to 60 characters."""
    lines = [_line(f"{1.4:8.1f}{'':12}M", "ANTEX VERSION / SYST"), _line("A", "PCV TYPE / REFANT")]
    lines += [_line(comment, "COMMENT") for comment in comments] + [_line("", "END OF HEADER")]
    for calibration in calibrations:
        lines += _antenna_lines(calibration)
    return "\n".join(lines) + "\n"


def _line(content: str, label: str) -> str:
    return f"{content[:_LABEL]:<60}{label}"


def _antenna_lines(c: AntennaCalibration) -> Iterator[str]:
    last_deg = (c.bands[0].variation_m.shape[1] - 1) * c.zenith_step_deg
    yield _line("", "START OF ANTENNA")
    yield _line(f"{c.antenna:<16}{c.radome:<4}{c.serial:<20}", "TYPE / SERIAL NO")
    yield _line(f"  {c.azimuth_step_deg:6.1f}", "DAZI")
    yield _line(f"  {0.0:6.1f}{last_deg:6.1f}{c.zenith_step_deg:6.1f}", "ZEN1 / ZEN2 / DZEN")
    yield _line(f"{len(c.bands):6d}", "# OF FREQUENCIES")
    for band in c.bands:
        yield _line(f"   {band.frequency}", "START OF FREQUENCY")
        east_m, north_m, up_m = band.offset_enu_m
        yield _line("".join(f"{value_m / _M_PER_MM:10.2f}" for value_m in (north_m, east_m, up_m)), "NORTH / EAST / UP")
        yield "   NOAZI" + _row(band.variation_m[: max(1, len(band.variation_m) - 1)].mean(axis=0))
        if c.azimuth_step_deg:
            yield from (f"{index * c.azimuth_step_deg:8.1f}{_row(row)}" for index, row in enumerate(band.variation_m))
        yield _line(f"   {band.frequency}", "END OF FREQUENCY")
    yield _line("", "END OF ANTENNA")


def _row(values_m: NDArray[np.float64]) -> str:
    return "".join(f"{value_m / _M_PER_MM:8.2f}" for value_m in values_m.tolist())
