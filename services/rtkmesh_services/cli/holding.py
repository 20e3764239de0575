"""What `rtkmesh up` holds of a deployment while it runs: its lock, and what is kept of it on this host."""

import logging
from dataclasses import dataclass, replace

from rtkmesh_schemas.keys import HUB_ID
from rtkmesh_services.control.adoption import end_all, wait_gone
from rtkmesh_services.control.fleet import LaunchOptions
from rtkmesh_services.control.memory import Memory
from rtkmesh_services.control.registry import DeploymentFolder, HeldError, Running, all_folders, folder_of, own_identity
from rtkmesh_services.errors import ServiceError
from rtkmesh_services.runtime.bus import endpoints_for
from rtkmesh_services.runtime.configuration import Site

_log = logging.getLogger("rtkmesh.control")


@dataclass(slots=True)
class Holding:
    """One control's hold on a deployment. ``outlive``: its processes run on when it dies; ``fresh``: forget what was stopped."""

    site: Site
    outlive: bool = False
    fresh: bool = False

    def take(self) -> Memory:
        """Become the only control; HeldError when there is one, or when processes run that a foreground could not end at its death."""
        folder = folder_of(self.site)
        try:
            folder.hold()
        except OSError as error:
            if self.outlive:
                raise ServiceError(f"{folder.folder}: {error.strerror}: without it no later control would find the processes") from error
            _log.warning("%s: %s: what is stopped by command is not kept", folder.folder, error.strerror)
            return Memory()
        left = folder.running()
        if not left.outlive:  # they die with the control that we come after
            wait_gone((entry.identity for entry in left.alive.values() if entry.identity), left.term_grace_s)
        if left.alive and not self.outlive:
            folder.release()
            remedy = "`rtkmesh up --detach` takes them over, `rtkmesh down` ends them"
            raise HeldError(f"{', '.join(left.alive)} of {left.name} run without control: {remedy}")
        self._end_strays(folder, left)
        return Memory(folder, self._running(), fresh=self.fresh)

    def options(self, options: LaunchOptions) -> LaunchOptions:
        """Return how processes are started: those that outlive us write into files."""
        return replace(options, logs=folder_of(self.site).logs) if self.outlive else options

    def _running(self) -> Running:
        deployment, hub = self.site.deployment.deployment, self.site.deployment.hub
        return Running(
            name=deployment.name,
            file=str(self.site.file),
            namespace=deployment.namespace,
            endpoints=tuple(endpoints_for(deployment.connect, hub.listen)),
            outlive=self.outlive,
            control=own_identity(),
            term_grace_s=self.site.deployment.control.term_grace_s,
        )

    def _end_strays(self, folder: DeploymentFolder, left: Running) -> None:
        """End what nobody knows: started by a control that died before it could write that down."""
        strays = folder.strays({entry.identity for entry in left.processes.values() if entry.identity is not None})
        if strays:
            _log.warning("not known, so ended: %s", ", ".join(f"{id_} (pid {who.pid})" for who, id_ in strays.items()))
            end_all(strays, left.term_grace_s)


def hub_runs(memory: Memory, site: Site) -> bool:
    """Whether the hub that has its port is ours to take over."""
    return HUB_ID in memory.left.alive and set(site.deployment.hub.listen) <= set(memory.left.endpoints)


def port_holder(endpoint: str) -> str:
    """Return which deployment of this host has an endpoint, empty if none that we know."""
    for folder in all_folders():
        running = folder.running()
        if endpoint in running.endpoints and (folder.is_held() or running.alive):
            return f"by {folder.folder.name} ({running.file}); `rtkmesh down {folder.folder.name}` ends it"
    return ""
