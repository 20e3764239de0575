"""``rtkmesh base``: the saved positions of base stations."""

import sys
import time
from math import degrees, nan
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
from cyclopts import App, Parameter

from rtkmesh_services.cli.network import EXIT_FAILED, EXIT_OK, EXIT_REFUSED, EXIT_USAGE, Json
from rtkmesh_services.cli.page import command_page

if TYPE_CHECKING:
    from rtkmesh_schemas.base import BasePosition
    from rtkmesh_services.ingest.base.presets import Preset


def list_(*, as_json: Json = False) -> int:
    """Show the saved positions of this host's base stations.

    Exit codes: 0 done, 1 none is saved, 2 the file cannot be read.
    """
    from rtkmesh_services.ingest.base.presets import PresetStore

    there = [preset.current for preset in PresetStore().all().values() if preset.current is not None]
    if as_json:
        _write_json(there)
    elif there:
        _print(there)
    else:
        sys.stdout.write("no position is saved\n")
    return EXIT_OK if there else EXIT_FAILED


def show(name: Annotated[str, Parameter(help="The position's name.")], /, *, as_json: Json = False) -> int:
    """Show a saved position and all that it replaced, newest first.

    Exit codes: 0 done, 1 there is none of that name, 2 the file cannot be read.
    """
    from rtkmesh_services.ingest.base.presets import PresetStore

    preset = PresetStore().all().get(name)
    if preset is None:
        return _absent(name)
    if as_json:
        _write_json(preset)
    else:
        _print_history(preset)
    return EXIT_OK


def save(
    name: Annotated[str, Parameter(help="The position's name.")],
    /,
    *,
    ecef: Annotated[str, Parameter(help="X,Y,Z in metres.")] = "",
    llh: Annotated[str, Parameter(help="LAT,LON in degrees and HEIGHT above the ellipsoid in metres.")] = "",
    accuracy: Annotated[float, Parameter(help="One sigma in three dimensions, metres.")] = 0.02,
    datum: Annotated[str, Parameter(help="The frame in words: ETRS89, ITRF2020 2026.0 ...")] = "",
    antenna: Annotated[str, Parameter(help="IGS name of the antenna.")] = "",
    replace: Annotated[bool, Parameter(negative="", help="Put it in the place of the one that is saved.")] = False,
) -> int:
    """Save a position that was surveyed by other means.

    Exit codes: 0 done, 2 wrong usage, 4 there is one of that name and --replace is not said.
    """
    from rtkmesh.gnss.ephemeris import ReferenceStation
    from rtkmesh_services.errors import CommandError
    from rtkmesh_services.ingest.base.commands import check_name
    from rtkmesh_services.ingest.base.found import Found
    from rtkmesh_services.ingest.base.presets import PresetStore

    position = _position(ecef, llh)
    if position is None or not 0.0 < accuracy <= 1000.0:
        sys.stderr.write("rtkmesh base save: needs either --ecef X,Y,Z or --llh LAT,LON,HEIGHT, and an accuracy above 0\n")
        return EXIT_USAGE
    found = Found(position, accuracy, "operator")
    try:
        check_name(name)
        made = found.saved_as(name, time.time_ns(), "command line", ReferenceStation(0), datum=datum, antenna=antenna)
        before = PresetStore().save(made, replace=replace)
    except CommandError as error:
        sys.stderr.write(f"rtkmesh base save: {error}\n")
        return EXIT_REFUSED
    sys.stdout.write(f"saved {name}{f' in place of that of {before.saved_utc}' if before else ''}\n")
    return EXIT_OK


def forget(name: Annotated[str, Parameter(help="The position's name.")], /) -> int:
    """Forget a saved position; its history stays (`rtkmesh base show`).

    Exit codes: 0 done, 1 there is none of that name, 2 the file cannot be written.
    """
    from rtkmesh_services.errors import CommandError
    from rtkmesh_services.ingest.base.presets import PresetStore

    try:
        PresetStore().forget(name)
    except CommandError:
        return _absent(name)
    sys.stdout.write(f"forgotten {name}\n")
    return EXIT_OK


def _position(ecef: str, llh: str) -> tuple[float, float, float] | None:
    """Return the position of one of two texts, None where they are wrong."""
    from rtkmesh_services.mapping.position import ecef_of

    try:
        one, two, three = (float(part) for part in (ecef or llh).split(","))
    except ValueError:
        one = two = three = nan
    if bool(ecef) == bool(llh):
        return None
    if llh:
        return ecef_of(None, (one, two, three)) if abs(one) <= 90.0 and abs(two) <= 360.0 and abs(three) < 1e5 else None
    return (one, two, three) if 6.2e6 < (one**2 + two**2 + three**2) ** 0.5 < 6.8e6 else None


def _absent(name: str) -> int:
    sys.stderr.write(f"rtkmesh base: no position {name!r}\n")
    return EXIT_FAILED


def _print(positions: list["BasePosition"]) -> None:
    from rtkmesh_services.cli.plain_table import print_table

    heads = ("name", "lat deg", "lon deg", "height m", "accuracy m", "datum", "source", "saved", "antenna")
    print_table(heads, [_cells(position) for position in positions], right=heads[1:5])


def _cells(position: "BasePosition") -> tuple[str, ...]:
    import numpy as np

    from rtkmesh.gnss.frames import geodetic_from_ecef

    lat_rad, lon_rad, height_m = geodetic_from_ecef(np.array(position.position_ecef_m)).tolist()
    place = f"{degrees(lat_rad):.9f}", f"{degrees(lon_rad):.9f}", f"{height_m:.4f}"
    return position.name, *place, f"{position.accuracy_m:.3f}", position.datum, position.source, position.saved_utc, position.antenna


def _print_history(preset: "Preset") -> None:
    if preset.current is None:
        sys.stdout.write("forgotten; before:\n")
    _print([*([preset.current] if preset.current else []), *preset.history])


def _write_json(value: Any) -> None:
    sys.stdout.write(msgspec.json.encode(value).decode() + "\n")


app = App(name="base", help="The saved positions of this host's base stations.")
for function, example, name_ in (
    (list_, "rtkmesh base list", "list"),
    (show, "rtkmesh base show roof --json", "show"),
    (save, "rtkmesh base save roof --llh 47.397742,8.545594,488.0 --accuracy 0.01 --datum ETRS89", "save"),
    (forget, "rtkmesh base forget roof", "forget"),
):
    app.command(command_page(function, example, name=name_))
