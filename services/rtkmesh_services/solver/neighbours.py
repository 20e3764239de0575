"""The processes around a solver, as they tell of themselves: its ingests, and the outputs and recorders of what it uses and makes."""

from dataclasses import dataclass

from rtkmesh_schemas.config import Deployment
from rtkmesh_schemas.errors import DecodeError, VersionError
from rtkmesh_schemas.keys import STATUS
from rtkmesh_schemas.status import ServiceStatus
from rtkmesh_schemas.wire import decode
from rtkmesh_services.runtime.bus import Sample
from rtkmesh_services.runtime.service import Context


@dataclass(slots=True)
class Neighbour:
    """The newest status of a process as bytes, and the one before; they are decoded only when somebody asks."""

    newest: Sample | None = None
    before: Sample | None = None

    def status(self) -> ServiceStatus | None:
        """Return the newest status; None where none has come."""
        return _decoded(self.newest)

    def pair(self) -> tuple[ServiceStatus, ServiceStatus] | None:
        """Return the last two statuses of one run of the process, older first; None where there are not two."""
        older, newer = _decoded(self.before), _decoded(self.newest)
        if older is None or newer is None or older.start_id != newer.start_id or newer.mono_ns <= older.mono_ns:
            return None
        return older, newer


def _decoded(sample: Sample | None) -> ServiceStatus | None:
    try:
        return None if sample is None else decode(ServiceStatus, sample.payload, sample.encoding)
    except (DecodeError, VersionError):
        return None


class Neighbours:
    """What the processes say whose streams the word ``stream`` shows."""

    def __init__(self, deployment: Deployment, solver: str) -> None:
        table = deployment.solver[solver]
        self.receivers = tuple(dict.fromkeys(name for name in (table.rover, table.base, *table.navigation) if name))
        self.outputs = tuple(name for name, output in deployment.output.items() if output.solver == solver)
        self.recorders = tuple(
            name
            for name, recorder in deployment.recorder.items()
            if not recorder.receivers or set(recorder.receivers) & set(self.receivers)
        )
        self._known = {name: Neighbour() for name in (*self.receivers, *self.outputs, *self.recorders)}

    def watch(self, context: Context) -> None:
        """Subscribe to their statuses."""
        for name in self._known:
            context.subscribe(STATUS.key(name), lane="status", latest=True, history=True)

    def take(self, sample: Sample) -> bool:
        """Take a status; False for another sample."""
        _, name, kind, *_ = sample.key.split("/")
        if kind != "status" or name not in self._known:
            return False
        known = self._known[name]
        known.before, known.newest = known.newest, sample
        return True

    def of(self, name: str) -> Neighbour:
        """Return a process."""
        return self._known.get(name) or Neighbour()
