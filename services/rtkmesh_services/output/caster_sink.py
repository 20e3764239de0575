"""To the clients of our own caster: receivers' frames, or a solver's text at a mount point."""

from collections.abc import Mapping
from dataclasses import replace
from math import atan2, degrees, hypot
from typing import Final

from rtkmesh_schemas.config import OutputTable
from rtkmesh_schemas.status import InputStatus
from rtkmesh_services.ntrip.caster import Caster
from rtkmesh_services.ntrip.source_table import MountPoint
from rtkmesh_services.output.sinks import SHOWN_CLIENTS
from rtkmesh_services.output.targets import TargetUrl
from rtkmesh_services.runtime.clock import Clock

RETRY_NS: Final = 1_000_000_000
_FLATTENING: Final = 0.00669438  # first eccentricity squared of WGS 84: the table says hundredths of a degree


class CasterSink:
    """Our own caster. What comes from one receiver or solver (``feeders``: mount point -> id) may be at several mount points."""

    def __init__(
        self, url: TargetUrl, feeders: Mapping[str, str], table: OutputTable, clock: Clock, form: str = "", header: bytes = b""
    ) -> None:
        self._url, self._feeders, self._table, self._clock, self._header = url, feeders, table, clock, header
        self._caster: Caster | None = None
        self._places = {name: MountPoint(name, feeder, format=form) for name, feeder in feeders.items()}
        self._tried_ns = -RETRY_NS
        self._sent = 0
        self.error = ""

    @property
    def dropped(self) -> int:
        """What clients were too slow for."""
        return 0 if self._caster is None else self._caster.dropped + sum(client.dropped for client in self._caster.clients())

    def send(self, data: bytes) -> None:
        """Hand a text to the caster's thread."""
        self.feed(next(iter(self._feeders.values())), data)

    def feed(self, feeder: str, data: bytes) -> None:
        """Hand what comes from a receiver or solver to the caster's thread."""
        self._sent += 1
        for mount, name in self._feeders.items():
            if name == feeder and self._caster is not None:
                self._caster.publish(mount, data)

    def place(self, feeder: str, position_ecef_m: tuple[float, float, float]) -> None:
        """Tell a place in the source table."""
        lat_deg, lon_deg = rough_place(position_ecef_m)
        for mount, name in self._feeders.items():
            if name == feeder:
                self._places[mount] = replace(self._places[mount], lat_deg=lat_deg, lon_deg=lon_deg)
                if self._caster is not None:
                    self._caster.describe(self._places[mount])

    def tick(self) -> None:
        """Listen when we do not yet."""
        now_mono_ns = self._clock.mono_ns()
        if self._caster is not None or now_mono_ns - self._tried_ns < RETRY_NS:
            return
        self._tried_ns = now_mono_ns
        table = self._table
        try:
            self._caster = Caster(self._url.host, self._url.port, self._places, table.users, table.maximum_clients, self._header)
            self._caster.start()
            self.error = ""
        except OSError as error:
            self.error = f"{self._url}: {error.strerror or error}"

    def statuses(self) -> list[InputStatus]:
        """Return the caster, then each client."""
        if self._caster is None:
            return [InputStatus(name="caster", state="error", detail=self.error)]
        clients = self._caster.clients()
        detail = f"{self._url}, {len(clients)} client{'s' if len(clients) != 1 else ''}"
        dropped, refused = self._caster.dropped, self._caster.refused
        caster = InputStatus(name="caster", state="listening", detail=detail, messages=self._sent, dropped=dropped, errors=refused)
        rows = [
            InputStatus(
                name=f"client {client.address}",
                state="served",
                detail=f"{client.mount}, version {client.version}, {client.user or 'anonymous'}, {client.agent}",
                bytes=client.bytes,
                dropped=client.dropped,
            )
            for client in clients[:SHOWN_CLIENTS]
        ]
        return [caster, *rows]

    def close(self) -> str:
        """Serve nobody any more."""
        if self._caster is not None:
            self._caster.close()
        return ""


def rough_place(position_ecef_m: tuple[float, float, float]) -> tuple[float, float]:
    """Return latitude and longitude in degrees of a place near the ground, good to a thousandth of a degree."""
    x, y, z = position_ecef_m
    return degrees(atan2(z, hypot(x, y) * (1.0 - _FLATTENING))), degrees(atan2(y, x))
