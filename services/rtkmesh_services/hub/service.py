"""The hub: this host's Zenoh router in a process of its own, which does nothing but route."""

from typing import Any, ClassVar

from rtkmesh_schemas.keys import Role
from rtkmesh_services.runtime.bus import Bus
from rtkmesh_services.runtime.configuration import Site
from rtkmesh_services.runtime.service import Context, Report, Service
from rtkmesh_services.runtime.zenoh_bus import open_router, router_config


class HubService(Service):
    """Says how the router is; the routing itself is Zenoh's own threads."""

    role: ClassVar[Role] = Role.HUB

    def handle(self, item: Any) -> None:
        """Nothing is subscribed."""

    def report(self) -> Report:
        """Return where it listens and how many sessions hang on it."""
        hub = self.context.deployment.hub
        return Report(counters={"sessions": self.context.bus.neighbours()}, data={"listen": list(hub.listen), "connect": list(hub.connect)})


def create(context: Context) -> Service:
    """Return the service; see ``runtime.service``."""
    return HubService(context)


def open_bus(site: Site, id: str) -> Bus:  # noqa: A002  the word of the design
    """Return the router's own session."""
    deployment = site.deployment
    return open_router(
        id, router_config(listen=deployment.hub.listen, connect=deployment.hub.connect, namespace=deployment.deployment.namespace)
    )
