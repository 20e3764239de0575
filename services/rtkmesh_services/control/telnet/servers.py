"""All telnet consoles of a deployment: begun with control, changed by ``reload``."""

from collections.abc import Mapping

from rtkmesh_schemas.config_telnet import TelnetTable
from rtkmesh_schemas.status import Level
from rtkmesh_services.control.telnet.server import TelnetServer
from rtkmesh_services.runtime.service import Context


class TelnetServers:
    """The consoles that the deployment file wants. One that cannot listen is told and tried again, and stops nothing else."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._wanted: Mapping[str, TelnetTable] = {}
        self._running: dict[str, TelnetServer] = {}
        self._faults: dict[str, str] = {}

    def apply(self, tables: Mapping[str, TelnetTable]) -> None:
        """Begin, change and end consoles until they are as the tables say; those that have not changed go on."""
        self._wanted = dict(tables)
        self._faults.clear()
        for id_, server in tuple(self._running.items()):
            if tables.get(id_) != server.table:
                self._running.pop(id_).close()
        self.try_again()

    def try_again(self) -> None:
        """Begin those that are wanted and do not run."""
        for id_, table in self._wanted.items():
            if id_ not in self._running:
                self._begin(id_, table)

    def close(self) -> None:
        """End all."""
        self._wanted = {}
        while self._running:
            self._running.popitem()[1].close()

    @property
    def faults(self) -> list[str]:
        """What keeps consoles from listening."""
        return list(self._faults.values())

    def counters(self) -> dict[str, int]:
        """Return what the consoles of all have counted; nothing without consoles."""
        if not self._wanted:
            return {}
        running = self._running.values()
        names = ("logins", "wrong_passwords", "turned_away")
        return {"telnet_clients": sum(one.clients for one in running)} | {
            f"telnet_{name}": sum(one.counters[name] for one in running) for name in names
        }

    def _begin(self, id_: str, table: TelnetTable) -> None:
        try:
            server = self._running[id_] = TelnetServer(id_, table, self._context)
        except OSError as error:
            text = f"telnet {id_} cannot listen on {table.listen}: {error.strerror or error}"
            if self._faults.get(id_) != text:
                self._faults[id_] = text
                self._context.event(Level.ERROR, "telnet_failed", text, console=id_)
            return
        self._faults.pop(id_, None)
        server.start()
        self._context.event(Level.INFO, "telnet_listens", f"telnet {id_}: console of {table.solver} on {table.listen}", console=id_)
