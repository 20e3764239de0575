"""``rtkmesh ports``: which serial ports there are, and who is behind them."""

import sys
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
from cyclopts import Parameter

from rtkmesh_services.cli.network import EXIT_FAILED, EXIT_OK, Json
from rtkmesh_services.cli.page import command_page

if TYPE_CHECKING:
    from rtkmesh_services.ingest.receivers.probe import Port, Probed


def ports(
    *devices: Annotated[str, Parameter(help="Only these ports, also ones that are no USB devices.")],
    probe: Annotated[bool, Parameter(negative="", help="Open each port that is free: baud rate and receiver (up to 20 s a port).")] = False,
    as_json: Json = False,
) -> int:
    """Show the serial ports: USB ids, names, and how a deployment file says them so that they are found again.

    With --probe each port that nobody uses is opened: what comes at which baud rate, and what the receiver calls itself.

    Exit codes: 0 done, 1 there is no port, 2 wrong usage.
    """
    from rtkmesh_services.ingest.receivers.probe import Port, by_id_name
    from rtkmesh_services.ingest.receivers.probe import ports as list_ports
    from rtkmesh_services.ingest.receivers.probe import probe as look

    found = list_ports()
    if devices:
        known = {port.device: port for port in found}
        found = [known.get(name) or Port(name, by_id=by_id_name(name), url=f"serial://{name}") for name in devices]
    rows = [(port, look(port.device) if probe else None) for port in found]
    if as_json:
        sys.stdout.write(msgspec.json.encode([_row(port, probed) for port, probed in rows]).decode() + "\n")
    elif rows:
        _print(rows, probe=probe)
    else:
        sys.stdout.write("no serial ports\n")
    return EXIT_OK if rows else EXIT_FAILED


def _row(port: "Port", probed: "Probed | None") -> dict[str, Any]:
    row: dict[str, Any] = msgspec.to_builtins(port)
    return {**row, "probe": msgspec.to_builtins(probed)} if probed is not None else row


def _print(rows: list[tuple["Port", "Probed | None"]], *, probe: bool) -> None:
    from rtkmesh_services.cli.plain_table import print_table

    heads = ("port", "USB ids", "product", "by-id", "source")
    cells = [(port.device, port.usb, port.product or port.looks_like, port.by_id, _source(port, probed)) for port, probed in rows]
    if probe:
        heads, cells = (*heads, "receiver"), [(*cell, _told(probed)) for cell, (_, probed) in zip(cells, rows, strict=True)]
    print_table(heads, cells)


def _source(port: "Port", probed: "Probed | None") -> str:
    return f"{port.url}?baud={probed.baud}" if probed is not None and probed.baud and "ttyACM" not in port.device else port.url


def _told(probed: "Probed | None") -> str:
    if probed is None:
        return ""
    if probed.state != "found":
        return probed.detail or probed.state
    sends = f", sends {' and '.join(probed.sends)}" if probed.sends else ", silent"
    return f"{probed.version or probed.receiver}{sends}, {probed.baud} baud"


app = command_page(
    ports,
    """
    rtkmesh ports
    rtkmesh ports --probe --json
    rtkmesh ports /dev/ttyS1 --probe
    """,
)
