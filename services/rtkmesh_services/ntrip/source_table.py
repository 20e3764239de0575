"""The source table of a caster: reading it (NTRIP 2.0, 2.2), choosing from it, writing our own."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from difflib import get_close_matches
from math import asin, cos, isfinite, nan, radians, sin, sqrt
from typing import Any, Final

EARTH_RADIUS_KM: Final = 6371.0
MAXIMUM_MOUNT_POINTS: Final = 20000
END_OF_TABLE: Final = b"ENDSOURCETABLE"
_FIELDS: Final = 19


@dataclass(frozen=True, slots=True)
class MountPoint:
    """A row STR. Angles in degrees (longitude from -180 on), NaN where the table says nothing sensible."""

    name: str
    identifier: str = ""
    format: str = ""
    details: str = ""
    carrier: int = 0
    systems: str = ""
    network: str = ""
    country: str = ""
    lat_deg: float = nan
    lon_deg: float = nan
    needs_gga: bool = False
    is_network: bool = False
    authentication: str = ""
    bitrate: int = 0

    def distance_km(self, lat_deg: float, lon_deg: float) -> float:
        """Return the great-circle distance to a place, NaN where the mount point has none."""
        dlat, dlon = radians(self.lat_deg - lat_deg), radians(self.lon_deg - lon_deg)
        chord = sin(dlat / 2.0) ** 2 + cos(radians(lat_deg)) * cos(radians(self.lat_deg)) * sin(dlon / 2.0) ** 2
        return 2.0 * EARTH_RADIUS_KM * asin(min(1.0, sqrt(chord))) if chord >= 0.0 else nan

    def row(self, lat_deg: float = nan, lon_deg: float = nan) -> dict[str, Any]:
        """Return the fields for JSON, with the distance to a place."""
        row = {**asdict(self), "distance_km": self.distance_km(lat_deg, lon_deg)}
        return {name: None if isinstance(value, float) and not isfinite(value) else value for name, value in row.items()}


def parse_table(content: bytes) -> list[MountPoint]:
    """Return the mount points of a source table; rows that are none are left out."""
    rows = (line.split(";") for line in _text(content).splitlines()[: 2 * MAXIMUM_MOUNT_POINTS] if line.startswith("STR;"))
    return [_mount_point(row) for row in rows if len(row) > 1 and row[1]][:MAXIMUM_MOUNT_POINTS]


def nearest_names(name: str, table: Iterable[MountPoint]) -> str:
    """Return ``; did you mean 'X'?``, or which mount points there are, or nothing."""
    names = [row.name for row in table]
    folded = {known.lower(): known for known in names}
    found = get_close_matches(name.lower(), folded, 1, 0.5)
    if found:
        return f"; did you mean {folded[found[0]]!r}?"
    return f"; there {'is' if len(names) == 1 else 'are'} {', '.join(names)}" if 0 < len(names) < 8 else ""


def nearest_mount(table: Iterable[MountPoint], lat_deg: float, lon_deg: float) -> MountPoint | None:
    """Return the nearest mount point that gives RTCM 3 with carrier phases of a real place; None without one."""
    fit = [row for row in table if _gives_observations(row) and isfinite(row.distance_km(lat_deg, lon_deg))]
    return min(fit, key=lambda row: row.distance_km(lat_deg, lon_deg), default=None)


def table_row(mount: MountPoint) -> str:
    """Return the row STR of a mount point of ours."""
    fields: list[Any] = [
        *("STR", mount.name, mount.identifier, mount.format, mount.details, mount.carrier, mount.systems, mount.network, mount.country),
        *(_angle(mount.lat_deg), _angle(mount.lon_deg), int(mount.needs_gga), int(mount.is_network), "rtkmesh", "none"),
        *(mount.authentication or "N", "N", mount.bitrate, ""),
    ]
    return ";".join(str(field).replace(";", ",") for field in fields)


def _mount_point(row: list[str]) -> MountPoint:
    field = [*row, *[""] * _FIELDS]
    lat_deg, lon_deg = _number(field[9]), _number(field[10])
    on_earth = -90.0 <= lat_deg <= 90.0 and -180.0 <= lon_deg <= 360.0 and (lat_deg, lon_deg) != (0.0, 0.0)
    return MountPoint(
        name=field[1],
        identifier=field[2],
        format=field[3],
        details=field[4],
        carrier=_whole(field[5]),
        systems=field[6],
        network=field[7],
        country=field[8],
        lat_deg=lat_deg if on_earth else nan,
        lon_deg=(lon_deg - 360.0 if lon_deg > 180.0 else lon_deg) if on_earth else nan,
        needs_gga=field[11].strip() == "1",
        is_network=field[12].strip() == "1",
        authentication=field[15],
        bitrate=_whole(field[17]),
    )


def _gives_observations(row: MountPoint) -> bool:
    """Return whether a row promises RTCM 3 of a station; a table that says nothing of phases is believed."""
    return row.format.upper().replace(" ", "").startswith(("RTCM3", "RTCMV3")) and not row.is_network


def _text(content: bytes) -> str:
    text = content.decode("utf-8", "replace")
    text = content.decode("cp1252", "replace") if "�" in text else text
    return "".join(character if character.isprintable() or character in "\r\n" else "�" for character in text)


def _angle(angle_deg: float) -> str:
    return f"{angle_deg:.2f}" if isfinite(angle_deg) else "0.00"


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return nan


def _whole(text: str) -> int:
    return int(text) if text.strip().isdecimal() and len(text) < 10 else 0
