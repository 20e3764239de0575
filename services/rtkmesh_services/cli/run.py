"""``rtkmesh run``: one process of one role in the foreground."""

import importlib
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from rtkmesh_schemas.errors import ConfigError
from rtkmesh_schemas.keys import HUB_ID, Role
from rtkmesh_services.cli.page import command_page


def run(
    role: Role,
    /,
    *,
    id: Annotated[str, Parameter(help="The process's name: its table in the file is \\[ROLE.ID].")] = "",  # noqa: A002  the word of the design
    config: Annotated[Path, Parameter(help="The deployment file (TOML).")],
    data: Annotated[Path | None, Parameter(help="Folder of the recordings: what {data} stands for.")] = None,
    speed: Annotated[str, Parameter(help="Replay recordings at this speed: 1, 10, ... or max.")] = "",
) -> None:
    """Run one process of a deployment in the foreground, as `rtkmesh up` does for each of them.

    It ends with SIGTERM or Ctrl-C within two seconds. Exit codes: 0 asked to end, 2 the file or the site is at fault,
    70 an uncaught exception, 75 cut off because it did not end in time.
    """
    from rtkmesh_services.runtime.bus import Bus, endpoints_for
    from rtkmesh_services.runtime.configuration import load_site, require_id
    from rtkmesh_services.runtime.extra_ingest import with_extra_ingest
    from rtkmesh_services.runtime.process import leave, run_service

    if role is Role.CONTROL:
        from rtkmesh_services.cli.up import up

        up(config, data=data, speed=speed, quiet=True)
    site = with_extra_ingest(load_site(config, data, speed), id)
    id = id or {Role.HUB: HUB_ID, Role.CONTROL: Role.CONTROL.value}.get(role, "")  # noqa: A001
    if not id:
        raise ConfigError(str(config), None, f"say which {role.value}: --id ID")
    require_id(site, role, id)
    module = importlib.import_module(f"rtkmesh_services.{role.value}.service")

    def open_bus() -> Bus:
        if hasattr(module, "open_bus"):
            opened: Bus = module.open_bus(site, id)
            return opened
        from rtkmesh_services.runtime import zenoh_bus

        deployment = site.deployment
        endpoints = endpoints_for(deployment.deployment.connect, deployment.hub.listen)
        return zenoh_bus.open_bus(id, endpoints, namespace=deployment.deployment.namespace)

    leave(run_service(module.create, role=role, id=id, site=site, open_bus=open_bus))


app = command_page(
    run,
    """
    rtkmesh run hub --config robot.toml
    rtkmesh run ingest --id rover --config robot.toml
    rtkmesh run solver --id rtk --config robot.toml
    """,
)
