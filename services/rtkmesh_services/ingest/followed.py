"""Another ingest as a source: its checked frames over the bus, for the second antenna of a receiver that has one port.

The other ingest publishes each frame as it came, all in one order; ephemerides come with them. What is written goes to the receiver
through the other ingest.
"""

import threading

from rtkmesh_schemas.keys import RAW, WRITE
from rtkmesh_services.ingest.links import Chunk, Link, LinkReport, LinkState, Sink
from rtkmesh_services.ingest.urls import SourceUrl
from rtkmesh_services.runtime.bus import Bus, Handle, Sample


class FollowedIngest:
    """The frames of another ingest in place of a link."""

    def __init__(self, url: SourceUrl, bus: Bus, sink: Sink, source: int = 0) -> None:
        self._id, self._bus, self._sink, self._source = url.path, bus, sink, source
        self._handle: Handle | None = None
        self._stop = threading.Event()
        self._heard = False

    def start(self, after: "Link | None" = None) -> None:
        """Subscribe."""
        del after
        self._say(LinkState.WAITING)
        self._handle = self._bus.subscribe(RAW.key(self._id, protocol="*"), self._take)

    def stop(self, wait_s: float = 0.0) -> None:
        """Subscribe no more; returns at once."""
        del wait_s
        self._stop.set()
        if self._handle is not None:
            self._handle.close()

    def write(self, data: bytes) -> bool:
        """Send bytes to the receiver through the other ingest, which counts those that it cannot send."""
        self._bus.publish_as(self._id, WRITE, data)
        return True

    def _take(self, sample: Sample) -> None:
        if self._stop.is_set():
            return
        if not self._heard:
            self._heard = True
            self._say(LinkState.CONNECTED)
        self._sink(Chunk(sample.payload, sample.received_mono_ns, self._source))

    def _say(self, state: LinkState) -> None:
        self._sink(LinkReport(state, f"ingest {self._id}", self._source))
