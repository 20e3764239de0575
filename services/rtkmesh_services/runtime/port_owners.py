"""Which process of a deployment has which serial port: a port is opened by one of them only."""

from collections.abc import Mapping
from urllib.parse import unquote

from rtkmesh_schemas.config import Deployment, IngestTable, OutputTable
from rtkmesh_services.runtime.port_names import is_same_port

_SERIAL = "serial://"


def ingest_of_port(deployment: Deployment, target: str) -> str:
    """Return the ingest that has the serial port of a target as one of its sources, "" without one."""
    name = _port_of(target)
    return next((id_ for id_, table in deployment.ingest.items() if name and any(is_same_port(name, port) for port in _ports(table))), "")


def baud_difference(deployment: Deployment, target: str) -> str:
    """Return what is wrong where a target's baud rate is not that of the ingest that has its port, or nothing."""
    owner = ingest_of_port(deployment, target)
    wanted = _baud_of(target)
    urls = (deployment.ingest[owner].source, *deployment.ingest[owner].fallback) if owner else ()
    has = next((_baud_of(url) for url in urls if _port_of(url) and is_same_port(_port_of(url), _port_of(target))), "")
    if not wanted or wanted == has:
        return ""
    return f"baud={wanted}: the port is that of [ingest.{owner}], which has it at {has or 'its own rate'}: leave it out"


def rival_of_port(outputs: Mapping[str, OutputTable], id: str) -> str:  # noqa: A002  the word of the design
    """Return another output before this one that has the same serial port, "" without one."""
    name = _port_of(outputs[id].target)
    before = list(outputs)[: list(outputs).index(id)]
    return next((other for other in before if name and (port := _port_of(outputs[other].target)) and is_same_port(name, port)), "")


def _ports(table: IngestTable) -> list[str]:
    return [name for url in (table.source, *table.fallback) if (name := _port_of(url))]


def _port_of(url: str) -> str:
    return unquote(url.removeprefix(_SERIAL).partition("?")[0]) if url.startswith(_SERIAL) else ""


def _baud_of(url: str) -> str:
    options = [part.partition("=") for part in url.partition("?")[2].split("&")]
    return next((value for name, _, value in options if name == "baud"), "")
