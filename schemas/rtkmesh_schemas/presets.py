"""Base stations as presets: what control tells of them, and what it keeps from one start to the next."""

import re
import zlib
from enum import StrEnum
from typing import Final

import msgspec

from rtkmesh_schemas.config_presets import PresetTable

# A chunk of a key, a file's name and an id of Flockwave at once.
PRESET_NAME: Final = re.compile(r"[A-Za-z0-9_.-]{1,64}")


def ingest_id(name: str) -> str:
    """Return the id of the process that a preset's stream is read by: ``base_NAME``, with a mark where NAME is no id."""
    plain = "".join(c if c in "abcdefghijklmnopqrstuvwxyz0123456789" else "_" for c in name.lower()).strip("_")
    mark = "" if plain == name and len(name) <= 48 else f"_{zlib.crc32(name.encode()):08x}"
    return f"base_{plain[:48]}{mark}"


class PresetType(StrEnum):
    """Where a preset is from: the deployment file, a serial port that was plugged in, a user."""

    BUILTIN = "builtin"
    DYNAMIC = "dynamic"
    USER = "user"


class Preset(msgspec.Struct, frozen=True, kw_only=True):
    """A base station that can be selected. ``table`` has all that it was made of; the rest is what others show."""

    id: str
    title: str
    format: str
    sources: tuple[str, ...]
    type: PresetType
    table: PresetTable
    accept: tuple[str, ...] = ()
    reject: tuple[str, ...] = ()
    auto_survey: bool = False
    auto_select: bool = False
    init: tuple[str, ...] = ()
    standby: bool = False


class PresetFile(msgspec.Struct, frozen=True, kw_only=True):
    """What users have made."""

    version: int = 1
    presets: dict[str, PresetTable] = {}


class Selection(msgspec.Struct, frozen=True, kw_only=True):
    """Which preset is selected for the fleet and, where they differ, for solvers; None: none. ``made``: somebody has chosen for all."""

    fleet: str | None = None
    solvers: dict[str, str | None] = {}
    made: bool = False
