"""Positions as Flockwave writes them: whole millimetres, and whole 1e-7 degrees. Without the engine: control is a light process."""

from math import degrees

from rtkmesh_services.texts.geodesy import geodetic

Position = tuple[float, float, float]


def millimetres(position_ecef_m: Position) -> Position:
    """Return an ECEFCoordinate (whole mm) of an ECEF position in metres."""
    x, y, z = (round(value_m * 1e3) for value_m in position_ecef_m)
    return x, y, z


def coordinate(position_ecef_m: Position) -> list[int | None]:
    """Return a GPSCoordinate of an ECEF position in metres.

    Latitude and longitude (1e-7 degrees), height (mm), height above home (not known). The first height is the one above the ellipsoid, as
    Skybrush has it, though the protocol says mean sea level.
    """
    lat_rad, lon_rad, height_m = geodetic(position_ecef_m)
    lon = round(degrees(lon_rad) * 1e7)
    return [round(degrees(lat_rad) * 1e7), lon if lon < 1_800_000_000 else lon - 3_600_000_000, round(height_m * 1e3), None]
