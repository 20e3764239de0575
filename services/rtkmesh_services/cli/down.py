"""``rtkmesh down``: end a deployment of this host, whether it has a control or not."""

import json
import signal
import sys
import time
from dataclasses import dataclass, field
from typing import Annotated

from cyclopts import Parameter

from rtkmesh_services.cli.deployments import Known, find, is_up, known_deployments
from rtkmesh_services.cli.network import EXIT_FAILED, EXIT_OK, EXIT_UNREACHABLE, Json
from rtkmesh_services.cli.page import command_page
from rtkmesh_services.control.adoption import end_all, hubs_last, wait_gone
from rtkmesh_services.control.memory import Memory
from rtkmesh_services.control.registry import Running
from rtkmesh_services.runtime.host_processes import Identity, send_signal


def down(
    name: Annotated[str, Parameter(name="FILE", help="The deployment: its file or its name. Not needed when only one is up.")] = "",
    /,
    *,
    timeout: Annotated[float, Parameter(help="Seconds for control to end its processes; then they are ended without it.")] = 10.0,
    as_json: Json = False,
) -> int:
    """End a deployment of this host: control, its processes, the hub last; wait until they are gone and say what has ended.

    Also works when control is dead or hangs. What commands have stopped is kept for the next `rtkmesh up`.

    Exit codes: 0 all have ended, 1 some are still there, 2 no such deployment, 3 none is up.
    """
    begun_s = time.monotonic()
    among = [known for known in known_deployments() if is_up(known)]
    if not among:
        sys.stderr.write("rtkmesh down: no deployment is up on this host\n")
        return EXIT_UNREACHABLE
    known = find(name, among)
    end = End(known)
    end.run(timeout)
    if as_json:
        sys.stdout.write(json.dumps({"deployment": end.name, "ended": end.ended, "left": end.left}) + "\n")
    else:
        sys.stdout.write(f"{end.name}: ended {', '.join(end.ended) or 'nothing'} in {time.monotonic() - begun_s:.1f} s\n")
    if end.left:
        sys.stderr.write(f"rtkmesh down: still there: {', '.join(f'{id_} (pid {pid})' for id_, pid in end.left.items())}\n")
    return EXIT_FAILED if end.left else EXIT_OK


@dataclass(slots=True)
class End:
    """The end of one deployment: by its control, and without it for what is left."""

    known: Known
    ended: list[str] = field(default_factory=list[str])
    left: dict[str, int] = field(default_factory=dict[str, int])

    @property
    def name(self) -> str:
        """The deployment's name on this host."""
        return self.known[0].folder.name

    def run(self, timeout_s: float) -> None:
        """Ask control to end, then see to it that nothing is left."""
        folder, running = self.known
        before = self._there(running)
        if (control := running.control) is not None and send_signal(control, signal.SIGTERM) and wait_gone([control], timeout_s):
            send_signal(control, signal.SIGKILL)
            wait_gone([control], running.term_grace_s)
        running = folder.running()
        self._end_rest(running)
        there = self._there(running)
        self.left = {id_: who.pid for id_, who in there.items()}
        self.ended = [id_ for id_, who in before.items() if there.get(id_) != who]
        if not there and not folder.is_held():
            Memory(folder, running).end()

    def _end_rest(self, running: Running) -> None:
        others, hubs = hubs_last(running.alive.values())
        strays = self._strays(running)
        end_all([*others, *strays], running.term_grace_s)
        end_all(hubs, running.term_grace_s)

    def _there(self, running: Running) -> dict[str, Identity]:
        found = {id_: entry.identity for id_, entry in running.alive.items() if entry.identity is not None}
        return found | {id_: who for who, id_ in self._strays(running).items() if id_ not in found}

    def _strays(self, running: Running) -> dict[Identity, str]:
        return self.known[0].strays({entry.identity for entry in running.processes.values() if entry.identity is not None})


app = command_page(
    down,
    """
    rtkmesh down
    rtkmesh down robot.toml
    rtkmesh down robot --timeout 5
    """,
)
