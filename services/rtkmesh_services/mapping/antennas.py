"""Antenna calibrations for the engine: the shipped table, and an ANTEX file of the user's before it."""

import lzma
from functools import cache
from importlib.resources import files
from pathlib import Path

from rtkmesh.codecs.antex import AntexFile
from rtkmesh.errors import FormatError, OptionError
from rtkmesh.models.antenna import Antenna, find_antenna
from rtkmesh.rtk.session import FindAntenna


def antenna_finder(antex: Path | None = None) -> FindAntenna:
    """Return what finds the antenna of an IGS name and serial number, or says why there is none; OptionError for a bad ANTEX file."""
    own = [] if antex is None else [_opened(antex)]

    def find(name: str, serial: str) -> Antenna | str:
        try:
            return find_antenna([*own, shipped_antennas()], name, serial)
        except FormatError as error:
            return str(error)

    return find


@cache
def shipped_antennas() -> AntexFile:
    """Return the table that comes with the package."""
    return AntexFile(lzma.decompress((files("rtkmesh") / "data" / "antennas.atx.xz").read_bytes()))


def _opened(path: Path) -> AntexFile:
    try:
        return AntexFile(path.read_bytes())
    except OSError as error:
        raise OptionError(f"{path}: {error.strerror}") from error
    except FormatError as error:
        raise OptionError(f"{path}: {error}") from error
