"""Who takes a solver's solutions in its deployment: outputs and attitudes. A replay begins when they are there."""

from rtkmesh_schemas.keys import SOL_TEXT
from rtkmesh_services.runtime.bus import Liveliness
from rtkmesh_services.runtime.service import Context


class Followers:
    """The processes of a deployment that subscribe to one solver; ``here`` when all have come, then for ever."""

    def __init__(self, context: Context) -> None:
        self._bus = context.bus
        deployment, me = context.deployment, context.id
        outputs = {id_: table for id_, table in deployment.output.items() if table.solver == me}
        attitudes = [id_ for id_, table in deployment.attitude.items() if me in table.takes_solutions_of]
        self._missing = {*outputs, *attitudes}
        self._formats = {table.format for table in outputs.values()} - {"json"}
        self._here = not self._missing

    def watch(self) -> None:
        """Begin to look; the formats are declared here, so that the bus knows their subscribers before the first solution."""
        if not self._here:
            self._bus.on_live(self._on_live)
            self._listened()

    def here(self) -> bool:
        """Return whether all have come."""
        self._here = self._here or (not self._missing and self._listened())
        return self._here

    def _listened(self) -> bool:
        listened = [self._bus.matched(SOL_TEXT, format=name) for name in self._formats]  # every one is declared by it
        return all(listened)

    def _on_live(self, change: Liveliness) -> None:
        if change.alive:
            self._missing.discard(change.id)
