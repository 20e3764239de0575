"""One id, one process: a second process of an id gives way to the one that was there before it."""

from typing import Final

from rtkmesh_schemas.errors import DecodeError, VersionError
from rtkmesh_schemas.keys import STATUS, Role
from rtkmesh_schemas.status import ServiceStatus, State
from rtkmesh_schemas.wire import decode
from rtkmesh_services.errors import NamesakeError
from rtkmesh_services.runtime.bus import Handle, Sample
from rtkmesh_services.runtime.service import Context

_PER_HOST: Final = frozenset({Role.HUB, Role.CONTROL})  # joined networks have one on each host
_GONE: Final = frozenset({State.STOPPED, State.FAILED})


class Namesake:
    """Listens for the heartbeats of another process with the same id. ``heard`` may run in any thread."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._since_ns = context.clock.mono_ns()
        self._beats: dict[str, int] = {}
        self._other: ServiceStatus | None = None

    def watch(self) -> list[Handle]:
        """Begin to listen; roles of which each host has one are not watched."""
        context = self._context
        return [] if context.role in _PER_HOST else [context.bus.subscribe(STATUS.key(context.id), self.heard)]

    def heard(self, sample: Sample) -> None:
        """Note an older process that is alive: two heartbeats, for one may be the last that a dead one had on its way."""
        try:
            status = decode(ServiceStatus, sample.payload, sample.encoding)
        except (DecodeError, VersionError):
            return
        if status.start_id == self._context.start_id or status.state in _GONE:
            return
        before = self._beats.setdefault(status.start_id, status.heartbeat)
        if status.heartbeat > before and self._is_older(status):
            self._other = status
            self._context.inbox.wake()

    def require_none(self) -> None:
        """Raise NamesakeError when there is an older process."""
        if (other := self._other) is not None:
            raise NamesakeError(
                f"another process has the id {other.id!r}: a {other.role}, pid {other.pid} on {other.host}, "
                f"up for {other.uptime_s:.0f} s; this one ends (one id, one process)"
            )

    def _is_older(self, other: ServiceStatus) -> bool:
        own_s = (self._context.clock.mono_ns() - self._since_ns) / 1e9
        return (other.uptime_s, other.start_id) > (own_s, self._context.start_id)
