"""``rtkmesh ntrip``: what a caster has."""

import os
import sys
from math import inf, isfinite, nan
from typing import TYPE_CHECKING, Annotated

import msgspec
from cyclopts import App, Parameter

from rtkmesh_services.cli.network import EXIT_FAILED, EXIT_OK, EXIT_REFUSED, EXIT_UNREACHABLE, EXIT_USAGE, Json
from rtkmesh_services.cli.page import command_page

if TYPE_CHECKING:
    from rtkmesh_services.ntrip.source_table import MountPoint

PASSWORD_VARIABLE = "RTKMESH_NTRIP_PASSWORD"  # noqa: S105  a name


def list_(
    caster: Annotated[str, Parameter(help="HOST, HOST:PORT, or a URL as in a deployment file (ntrips:// for TLS).")],
    /,
    *,
    near: Annotated[str, Parameter(help="LAT,LON in degrees: nearest mount points first, with distances.")] = "",
    user: Annotated[str, Parameter(help=f"User, where the table is not public; the password comes from {PASSWORD_VARIABLE}.")] = "",
    limit: Annotated[int, Parameter(help="At most so many rows; 0: all.")] = 0,
    as_json: Json = False,
) -> int:
    """Show the mount points of an NTRIP caster: its source table.

    Exit codes: 0 done, 1 the table is empty, 2 wrong usage, 3 no caster answers, 4 the caster refuses.
    """
    from rtkmesh_services.errors import RefusedError, SourceError
    from rtkmesh_services.ntrip.address import CasterAddress, parse_caster
    from rtkmesh_services.ntrip.connection import fetch_table

    place = _place(near)
    if place is None:
        sys.stderr.write(f"rtkmesh ntrip list: --near {near!r} is no LAT,LON in degrees\n")
        return EXIT_USAGE
    address, _ = parse_caster(caster if "://" in caster else f"ntrip://{caster}")
    if user:
        address = CasterAddress(address.host, address.port, "", user, os.environ.get(PASSWORD_VARIABLE, ""), tls=address.tls)
    try:
        table = fetch_table(address)
    except SourceError as error:
        sys.stderr.write(f"rtkmesh ntrip list: {error}\n")
        return EXIT_REFUSED if isinstance(error, RefusedError) else EXIT_UNREACHABLE
    rows = sorted(table, key=lambda row: distance if isfinite(distance := row.distance_km(*place)) else inf) if near else table
    rows = rows[:limit] if limit > 0 else rows
    if as_json:
        sys.stdout.write(msgspec.json.encode([row.row(*place) for row in rows]).decode() + "\n")
    else:
        _print(rows, place)
    return EXIT_OK if rows else EXIT_FAILED


def _place(near: str) -> tuple[float, float] | None:
    """Return latitude and longitude, NaN where none is asked for, None where they are wrong."""
    if not near:
        return nan, nan
    try:
        lat_deg, lon_deg = (float(part) for part in near.split(","))
    except ValueError:
        return None
    return (lat_deg, lon_deg) if -90.0 <= lat_deg <= 90.0 and -180.0 <= lon_deg <= 360.0 else None


def _print(rows: list["MountPoint"], place: tuple[float, float]) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=SIMPLE_HEAD, pad_edge=False, header_style="dim")
    for name in ("mount point", "place", "format", "systems", "lat", "lon", "km", "wants"):
        table.add_column(name, justify="right" if name in ("lat", "lon", "km") else "left", no_wrap=name != "place")
    for row in rows:
        wants = ", ".join(word for word, wanted in (("position", row.needs_gga), ("password", row.authentication in ("B", "D"))) if wanted)
        numbers = [f"{value:.2f}" if isfinite(value) else "-" for value in (row.lat_deg, row.lon_deg)]
        distance_km = row.distance_km(*place)
        cells = [row.name, row.identifier, row.format, row.systems, *numbers, f"{distance_km:.1f}" if isfinite(distance_km) else "-", wants]
        table.add_row(*(Text(cell) for cell in cells))
    console = Console()
    Console(width=console.width if console.is_terminal else 160).print(table)


app = App(name="ntrip", help="Ask an NTRIP caster.")
app.command(
    command_page(
        list_,
        """
        rtkmesh ntrip list caster.example
        rtkmesh ntrip list ntrips://caster.example:443 --near 52.5,13.4 --limit 5
        rtkmesh ntrip list caster.example:2101 --json
        """,
        name="list",
    )
)
