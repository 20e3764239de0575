"""The selected base as Flockwave shows it: a connection, a beacon, statistics; and what clients are told when one of them changes."""

from collections.abc import Callable
from typing import Any, Final

import msgspec

from rtkmesh_schemas.flockwave import PURPOSE_RTK, BeaconBasicProperties, BeaconStatusInfo, Body, ConnectionInfo, IdList, Statuses
from rtkmesh_schemas.keys import OBS, RAW, REF
from rtkmesh_schemas.observation import Observation, ReferenceMessage
from rtkmesh_schemas.presets import Preset
from rtkmesh_schemas.status import ServiceStatus
from rtkmesh_schemas.wire import decode
from rtkmesh_services.control.flockwave.coordinates import coordinate
from rtkmesh_services.control.flockwave.statistics import BaseStatistics, Forwarding
from rtkmesh_services.runtime.bus import Sample
from rtkmesh_services.runtime.service import Context

BEACON: Final = "rtk::base_0"
BEACON_NS: Final = 15_000_000_000  # a base that has not said its position for so long is no active beacon
LANE: Final = "base"

Tell = Callable[[Body], None]


class SelectedBase:
    """A preset from its selection to the next one. ``ingest`` is the process that receives it, empty: none does."""

    def __init__(self, context: Context, preset: Preset, ingest: str, tell: Tell, *, basic: bool) -> None:
        self._context, self._tell = context, tell
        self.preset, self.ingest = preset, ingest
        self.statistics = BaseStatistics(Forwarding(preset.accept, preset.reject, basic=basic))
        self._connected = False
        self._said = 0
        self._beacon: tuple[int, BeaconStatusInfo] | None = None
        self._handles = [] if not ingest else [
            context.subscribe(RAW.key(ingest, protocol="rtcm3"), lane=LANE),
            context.subscribe(OBS.key(ingest), lane=LANE),
            context.subscribe(REF.key(ingest), lane=LANE, history=True),
        ]  # fmt: skip

    @property
    def connection(self) -> str:
        """The id of the connection."""
        return f"rtk:{self.preset.id}"

    def enter(self) -> None:
        """Tell that it was selected."""
        self._tell_connection()

    def leave(self) -> None:
        """Tell that it is selected no more, and let go of its data."""
        for handle in self._handles:
            handle.close()
        self._tell(IdList(type="CONN-DEL", ids=[self.connection]))
        if self._beacon is not None:
            self._tell(IdList(type="OBJ-DEL", ids=[BEACON]))
        self._tell(Statuses(type="CONN-INF", status={}))

    def takes(self, sample: Sample) -> bool:
        """Take a message of the base; return whether it is one."""
        if not self.ingest:
            return False
        now_ns = sample.received_mono_ns
        if sample.key == RAW.key(self.ingest, protocol="rtcm3"):
            self.statistics.frame(sample.payload, now_ns)
        elif sample.key == OBS.key(self.ingest):
            self.statistics.epoch(decode(Observation, sample.payload, sample.encoding), now_ns)
        elif sample.key == REF.key(self.ingest):
            self.statistics.reference(decode(ReferenceMessage, sample.payload, sample.encoding), now_ns)
        else:
            return False
        return True

    def status(self, status: ServiceStatus, now_ns: int) -> None:
        """Take the status of the base's ingest."""
        self.statistics.status(status, now_ns)
        if self.statistics.is_connected() != self._connected:
            self._connected = not self._connected
            self._tell_connection()

    def tick(self, now_ns: int) -> None:
        """Tell of the beacon when the base has said its position, and when it does so no more."""
        position = self.statistics.position(now_ns)
        if self.statistics.position_said != self._said and position is not None:
            self._said = self.statistics.position_said
            self._beacon = now_ns, self._beacon_at(coordinate(position), active=True)
            self._tell_beacon()
        elif self._beacon is not None and self._beacon[1].active and now_ns - self._beacon[0] > BEACON_NS:
            self._beacon = self._beacon[0], self._beacon_at(self._beacon[1].position, active=False)
            self._tell_beacon()

    def connections(self) -> dict[str, dict[str, Any]]:
        """Return ConnectionInfo by id."""
        info = ConnectionInfo(
            id=self.connection,
            description=f"RTK corrections ({self.preset.title})",
            purpose=PURPOSE_RTK,
            status="connected" if self._connected else "connecting",
            timestamp=self._utc_ms(),
        )
        return {self.connection: msgspec.to_builtins(info)}

    def beacons(self) -> dict[str, dict[str, Any]]:
        """Return BeaconStatusInfo by id."""
        return {} if self._beacon is None else {BEACON: msgspec.to_builtins(self._beacon[1])}

    def beacon_names(self) -> dict[str, BeaconBasicProperties]:
        """Return BeaconBasicProperties by id."""
        name = f"RTK base station ({self.preset.title})"
        return {} if self._beacon is None else {BEACON: BeaconBasicProperties(id=BEACON, name=name)}

    def _beacon_at(self, position: list[int | None], *, active: bool) -> BeaconStatusInfo:
        return BeaconStatusInfo(id=BEACON, position=position, heading=None, active=active, timestamp=self._utc_ms())

    def _tell_connection(self) -> None:
        self._tell(Statuses(type="CONN-INF", status=self.connections()))

    def _tell_beacon(self) -> None:
        self._tell(Statuses(type="BCN-INF", status=self.beacons()))

    def _utc_ms(self) -> int:
        return self._context.clock.utc_ns() // 1_000_000
