"""Who takes a solver's solutions in its deployment: outputs and attitudes. A replay begins when they are there."""

from rtkmesh_schemas.keys import SAT, SOL
from rtkmesh_services.runtime.bus import Liveliness
from rtkmesh_services.runtime.service import Context


class Followers:
    """The processes of a deployment that subscribe to one solver; ``here`` when all have come, then for ever.

    ``wants_satellites``: one of them writes the satellites of every epoch.
    """

    def __init__(self, context: Context) -> None:
        self._bus = context.bus
        deployment, me = context.deployment, context.id
        outputs = {id_: table for id_, table in deployment.output.items() if table.solver == me}
        attitudes = [id_ for id_, table in deployment.attitude.items() if table.solver == me]
        self._missing = {*outputs, *attitudes}
        self.wants_satellites = any(table.takes_satellites for table in outputs.values())
        self._here = not self._missing

    def watch(self) -> None:
        """Begin to look; the streams are declared here, so that the bus knows their subscribers before the first solution."""
        if not self._here:
            self._bus.on_live(self._on_live)
            self._listened()

    def here(self) -> bool:
        """Return whether all have come."""
        self._here = self._here or (not self._missing and self._listened())
        return self._here

    def _listened(self) -> bool:
        wanted = [SOL, SAT] if self.wants_satellites else [SOL]
        listened = [self._bus.matched(stream) for stream in wanted]  # every one is declared by it
        return all(listened)

    def _on_live(self, change: Liveliness) -> None:
        if change.alive:
            self._missing.discard(change.id)
