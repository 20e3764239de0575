"""The fields of a preset that comes by a message: checked, and put into words as Flockwave's peers know them."""

from collections.abc import Mapping
from typing import Any, Final, get_args

import msgspec

from rtkmesh_schemas.config_presets import PresetFormat, PresetTable
from rtkmesh_services.errors import ServiceError
from rtkmesh_services.runtime.preset_checks import source_fault
from rtkmesh_services.runtime.words import clip, nearest

NO_MATCH: Final = "Preset does not match expected schema"
NO_SUCH: Final = "No such RTK preset"
NOT_OURS: Final = "Only user-defined presets can be deleted"
FIELDS: Final = tuple(field.name for field in msgspec.structs.fields(PresetTable))


class PresetError(ServiceError):
    """A preset that is not there, is not ours to change, or is none; the text is for who asked."""


def new_table(fields: Mapping[str, Any]) -> PresetTable:
    """Return the table of a new preset; ``source`` is a short form of ``sources``. PresetError says what is wrong."""
    return _made(_plain(fields))


def changed_table(table: PresetTable, fields: Mapping[str, Any]) -> PresetTable:
    """Return a table with some fields changed (None: back to what it is without). PresetError says what is wrong."""
    merged = {**msgspec.to_builtins(table), **_plain(fields)}
    return _made({name: value for name, value in merged.items() if value is not None})


def check_sources(sources: tuple[str, ...]) -> None:
    """PresetError unless every source is a live one of a kind that there is."""
    for source in sources:
        if fault := source_fault(source):
            raise PresetError(f"{NO_MATCH}: {fault}")


def _plain(fields: Mapping[str, Any]) -> dict[str, Any]:
    given = dict(fields)
    for name in ("id", "type"):
        if name in given:
            raise PresetError(f"Preset must not have {'an ID' if name == 'id' else 'a type'}")
    if "source" in given:
        source = given.pop("source")
        given.setdefault("sources", source if isinstance(source, list) else [source])
    for name in given:
        if name not in FIELDS:
            raise PresetError(f"{NO_MATCH}: unknown field {clip(str(name))!r}{nearest(str(name), list(FIELDS))}")
    if (form := given.get("format")) is not None and form not in get_args(PresetFormat):
        raise PresetError(f"Invalid RTK packet format: {clip(str(form))!r}")
    if isinstance(given.get("sources"), str):
        given["sources"] = [given["sources"]]
    return given


def _made(values: dict[str, Any]) -> PresetTable:
    try:
        table = msgspec.convert(values, PresetTable)
    except msgspec.ValidationError as error:
        raise PresetError(f"{NO_MATCH}: {error}") from error
    if table.position_ecef_m is not None and table.position_llh_deg is not None:
        raise PresetError(f"{NO_MATCH}: two positions: say either position_ecef_m or position_llh_deg")
    check_sources(table.sources)
    return table
