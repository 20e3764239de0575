"""What is checked of ``[telnet.ID]``: the solver, where it listens, and that nobody is let in from elsewhere without a password."""

from rtkmesh_schemas.config import Deployment
from rtkmesh_schemas.config_telnet import TelnetTable
from rtkmesh_services.runtime.addresses import address_of, is_loopback
from rtkmesh_services.runtime.file_faults import Faults
from rtkmesh_services.runtime.words import clip, nearest


def check_telnet(reader: Faults, deployment: Deployment) -> None:
    """Gather the faults of the consoles of a deployment."""
    taken: dict[str, str] = {}
    known = reader.names_of("solver")
    for id_, table in deployment.telnet.items():
        if table.solver not in known:
            there = nearest(table.solver, known) or f"; there {'are' if len(known) != 1 else 'is'} {', '.join(known) or 'none'}"
            reader.fault(("telnet", id_, "solver"), f"[telnet.{id_}] solver: no [solver.{clip(table.solver)}]{there}")
        if table.password and not (table.password.isascii() and table.password.isprintable()):
            reader.fault(
                ("telnet", id_, "password"), f"[telnet.{id_}] password: printable characters of ASCII only: telnet carries no others"
            )
        if fault := _address_fault(table):
            reader.fault(("telnet", id_, "listen"), f"[telnet.{id_}] listen: {clip(table.listen)!r} {fault}")
        elif (other := taken.setdefault(table.listen, id_)) != id_:
            reader.fault(("telnet", id_, "listen"), f"[telnet.{id_}] listen: {table.listen} is that of [telnet.{other}]")


def _address_fault(table: TelnetTable) -> str:
    try:
        host, _ = address_of(table.listen)
    except ValueError as error:
        return str(error)
    if is_loopback(host) or table.password:
        return ""
    return "is no loopback address; others could command your solver: it needs a password"
