"""What an ingest says to its receiver beyond commands, and what it takes from the answers: corrections, and a base's position.

Runs in the work loop; does nothing (and costs nothing) where neither is configured.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Any, Final

import msgspec

from rtkmesh.codecs.messages import Frame, Message, Protocol
from rtkmesh.codecs.rtcm3_station import StationDecoder
from rtkmesh.gnss.ephemeris import ReceiverFix, ReferenceStation
from rtkmesh_schemas.command import Code, Reply, Request
from rtkmesh_schemas.config import IngestTable
from rtkmesh_schemas.status import InputStatus
from rtkmesh_services.errors import CommandError
from rtkmesh_services.ingest.base.commands import OPERATIONS, base_command
from rtkmesh_services.ingest.base.station import BaseStation, Publish
from rtkmesh_services.ingest.base.status import survey_status
from rtkmesh_services.ingest.correction_feed import CorrectionFeed
from rtkmesh_services.ingest.corrections import CorrectionQueue
from rtkmesh_services.ingest.feedback import verdict_of_frame, verdict_of_line
from rtkmesh_services.ingest.links import LinkState
from rtkmesh_services.ingest.receivers.orders import TextLines
from rtkmesh_services.runtime.bus import Sample
from rtkmesh_services.runtime.service import Context

_POSITIONS: Final = ("1005", "1006")


class Dialogue:
    """The corrections and the base station of one ingest. ``send`` queues bytes for the receiver."""

    operations: Mapping[str, str] = OPERATIONS

    def __init__(self, context: Context, table: IngestTable, send: Callable[[bytes], bool], publish: Publish) -> None:
        self._feed = None if table.corrections is None else CorrectionFeed(context, table.corrections)
        self._station = None if table.base_station is None else BaseStation(context, table.base_station, send, publish)
        self._lines = TextLines() if self._feed is not None or self._station is not None else None

    @property
    def corrections(self) -> CorrectionQueue | None:
        """The queue of the receiver's writer."""
        return None if self._feed is None else self._feed.queue

    def open(self) -> None:
        """Subscribe to bases."""
        if self._feed is not None:
            self._feed.open()

    def takes(self, sample: Sample, now_s: float) -> bool:
        """Take a frame of a base; return whether it is one."""
        return self._feed is not None and self._feed.takes(sample, now_s)

    def link(self, state: LinkState, now_s: float) -> None:
        """Take what the link to the receiver says."""
        if self._station is None:
            return
        if state is LinkState.CONNECTED:
            self._station.connected(now_s)
        elif state in (LinkState.ERROR, LinkState.CONNECTING):
            self._station.lost()

    def heard(self, data: bytes, frames: Iterable[Frame], now_s: float) -> None:
        """Take the bytes that came, and the frames that are whole with them."""
        if self._lines is None:
            return
        for frame in frames:
            if frame.protocol is Protocol.UBX:
                self._ubx(frame, now_s)
            elif self._station is not None and frame.kind in _POSITIONS and frame.protocol is Protocol.RTCM3:
                station = StationDecoder().decode(frame.data[3:-3], int(frame.kind))
                if isinstance(station, ReferenceStation) and station.position_ecef_m is not None:
                    self._station.sent(station.position_ecef_m, now_s)
        for line in self._lines.feed(data):
            if self._feed is not None and (verdict := verdict_of_line(line)) is not None:
                self._feed.feedback.hear(verdict, now_s)
            if self._station is not None:
                self._station.hear(line, now_s)

    def message(self, message: Message, now_s: float) -> None:
        """Take a decoded message."""
        if self._station is None:
            return
        if isinstance(message, ReceiverFix):
            self._station.fix(message, now_s)
        elif isinstance(message, ReferenceStation):
            self._station.reference(message)

    def tick(self, now_s: float) -> None:
        """Do what time asks for."""
        if self._feed is not None:
            self._feed.tick(now_s)
        if self._station is not None:
            self._station.tick(now_s)

    def command(self, request: Request, now_s: float) -> Reply:
        """Do a command to the base station."""
        if self._station is None:
            raise CommandError(Code.WRONG_STATE, "this receiver is no base station: it has no table [ingest.ID.base_station]")
        return base_command(self._station, request, now_s)

    def complaint(self, now_s: float) -> str:
        """Return what is wrong, or nothing."""
        wrong = "" if self._station is None else self._station.complaint()
        return wrong or ("" if self._feed is None else self._feed.complaint(now_s))

    def statuses(self, now_s: float) -> list[InputStatus]:
        """Return the rows of the status."""
        return [] if self._feed is None else [self._feed.status(now_s)]

    def data(self, now_s: float) -> dict[str, Any]:
        """Return what the status tells."""
        told: dict[str, Any] = {}
        if self._feed is not None:
            told["corrections"] = self._feed.data(now_s)
        if self._station is not None:
            told["base_station"] = msgspec.to_builtins(survey_status(self._station, now_s))
        return told

    def _ubx(self, frame: Frame, now_s: float) -> None:
        if self._feed is not None and (verdict := verdict_of_frame(frame)) is not None:
            self._feed.feedback.hear(verdict, now_s)
        if self._station is not None:
            self._station.hear(frame, now_s)
