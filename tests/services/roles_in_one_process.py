"""Processes of a deployment as they are, step by step in one process on an in-memory bus."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from rtkmesh_schemas.config import Deployment
from rtkmesh_schemas.keys import Role
from rtkmesh_services.runtime.clock import ManualClock
from rtkmesh_services.runtime.lifecycle import Lifecycle
from rtkmesh_services.runtime.memory_bus import MemoryBus, MemoryNetwork
from rtkmesh_services.runtime.service import Context, Service


@dataclass(frozen=True)
class Site:
    """Where processes live: their network, their clock, the folder of their configurations."""

    network: MemoryNetwork
    clock: ManualClock
    folder: Path = Path()

    def begin(self, name: str, role: Role, make: Callable[[Context], Service], deployment: Deployment) -> tuple[Lifecycle, MemoryBus]:
        """Start a process and return its loop and its bus."""
        bus = MemoryBus(name, self.network)
        context = Context(id=name, role=role, deployment=deployment, bus=bus, clock=self.clock, config_folder=self.folder)
        life = Lifecycle(make(context), warm_in_thread=False)
        life.start()
        life.step(0.0)
        return life, bus


def settle(lives: Iterable[Lifecycle]) -> None:
    """Step all until nothing waits."""
    for _ in range(2):
        for life in lives:
            while life.context.inbox.depth():
                life.step(0.0)
            life.step(0.0)
