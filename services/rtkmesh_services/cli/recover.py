"""``rtkmesh recover``: raw logs after a crash or a power cut."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
from cyclopts import Parameter

from rtkmesh_services.cli.network import EXIT_FAILED, EXIT_OK, Json
from rtkmesh_services.cli.page import command_page
from rtkmesh_services.errors import SourceError

if TYPE_CHECKING:
    from rtkmesh_services.recorder.recovery import Finding


def recover(
    folder: Annotated[Path, Parameter(help="A recorder's folder (with those below it), or one log.")],
    /,
    *,
    as_json: Json = False,
) -> int:
    """Look at the raw logs of a folder, and write what is whole of those that were cut, with times that fit.

    The originals are never changed: what is recovered stands beside them, rover-20261126T093000Z.recovered.ubx with its .times and .tag.
    A log that is whole gets no copy. Not for logs that are being written.

    Exit codes: 0 all logs are whole or recovered, 1 one could not be read or written, 2 there is no such folder.
    """
    from rtkmesh_services.recorder.recovery import logs_of
    from rtkmesh_services.recorder.recovery import recover as recover_log

    if not folder.exists():
        raise SourceError(f"{folder}: there is no such folder")
    found = [recover_log(path) for path in ([folder] if folder.is_file() else logs_of(folder))]
    if as_json:
        sys.stdout.write(msgspec.json.encode([row.row() for row in found]).decode() + "\n")
    else:
        _show(found, folder)
    return EXIT_FAILED if any(row.error for row in found) else EXIT_OK


def _show(found: "list[Finding]", folder: Path) -> None:
    from rich.console import Console
    from rich.text import Text

    console = Console(highlight=False, soft_wrap=True)
    for row in found:
        word, style = ("failed", "bold red") if row.error else ("recovered", "yellow") if row.written else ("whole", "green")
        console.print(Text.assemble((f"{word:<9}", style), f"  {row.path}  {row.frames} frames, {row.bytes} bytes"))
        if row.gap_bytes:
            console.print(Text(f"           {row.gap_bytes} bytes between frames are of no frame; they are kept"))
        for fault in row.faults:
            console.print(Text(f"           {fault}"))
        if row.written or row.error:
            when = "was written before" if row.before else "written"
            console.print(Text(f"           {row.error or f'{when}: {row.written[0]}'}"))
    if not found:
        console.print(f"{folder}: no raw logs")


app = command_page(
    recover,
    """
    rtkmesh recover /data/20261126
    rtkmesh recover logs/rover-20261126T093000Z.ubx --json
    """,
)
