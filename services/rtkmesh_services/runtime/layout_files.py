"""Layout files of ``[attitude.ID]``: places of antennas as ``rtkmesh antennas calibrate`` writes them.

Such a file has tables ``[antennas.NAME]``, or ``[attitude.ID.antennas.NAME]`` of one or more attitudes (then those of this ID, or
of the only one there is).
"""

from typing import Any, Protocol, TypeVar

import msgspec

from rtkmesh_schemas.config import Deployment
from rtkmesh_schemas.config_attitude import AntennaPlaceTable, AttitudeTable

T = TypeVar("T", bound=msgspec.Struct)


class LayoutReader(Protocol):
    """One TOML text on its way into structs, gathering faults."""

    raw: dict[str, Any]

    def fault(self, path: tuple[str, ...], message: str) -> None:
        """Gather one fault at a key."""
        ...

    def table(self, kind: type[T], table: Any, path: tuple[str, ...]) -> T | None:
        """Return the struct in a table, or None with the faults gathered."""
        ...


def antennas_of(reader: LayoutReader, id: str) -> dict[str, AntennaPlaceTable]:  # noqa: A002  the word of the design
    """Return the places of the antennas in a layout file for one attitude."""
    path, tables = _found(reader.raw, id)
    if not tables:
        reader.fault((), f"no [antennas.NAME] and no [attitude.{id}.antennas.NAME] in it")
    rows = ((name, reader.table(AntennaPlaceTable, row, (*path, name))) for name, row in tables.items())
    return {name: made for name, made in rows if made is not None}


def with_antennas(deployment: Deployment, found: dict[str, dict[str, AntennaPlaceTable]]) -> Deployment:
    """Return the deployment with places of antennas by attitude; those that its own file says go before them."""
    tables = {id_: _with(table, found.get(id_, {})) for id_, table in deployment.attitude.items()}
    return msgspec.structs.replace(deployment, attitude=tables)


def _with(table: AttitudeTable, antennas: dict[str, AntennaPlaceTable]) -> AttitudeTable:
    return msgspec.structs.replace(table, antennas={**antennas, **table.antennas})


def _found(raw: dict[str, Any], id: str) -> tuple[tuple[str, ...], dict[str, Any]]:  # noqa: A002
    """Return where the tables of antennas are, and them."""
    if "antennas" in raw:
        return ("antennas",), _table(raw, "antennas")
    attitudes = _table(raw, "attitude")
    name = id if id in attitudes or len(attitudes) != 1 else next(iter(attitudes))
    return ("attitude", name, "antennas"), _table(_table(attitudes, name), "antennas")


def _table(raw: dict[str, Any], name: str) -> dict[str, Any]:
    below = raw.get(name)
    return below if isinstance(below, dict) else {}  # pyright: ignore[reportUnknownVariableType]  any TOML
