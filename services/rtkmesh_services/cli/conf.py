"""``rtkmesh conf``: RTKLIB's .conf files in and out; what a file means; what differs between two."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
from cyclopts import App, Parameter

from rtkmesh_services.cli.network import EXIT_OK, EXIT_USAGE, Json
from rtkmesh_services.cli.page import command_page

if TYPE_CHECKING:
    from rtkmesh_services.conf.importer import Imported

EXIT_NOT_UNDERSTOOD = EXIT_DIFFERENT = 1
DialectFlag = Annotated[
    Literal["auto", "2.4", "demo5"],
    Parameter(help="Whose numbers and keys: RTKLIB 2.4.x, demo5 (RTKLIB EX), or found from what the file has of one alone."),
]


def import_(
    file: Annotated[Path, Parameter(help="RTKLIB's .conf file, of rtkrcv, RTKNAVI, rnx2rtkp or RTKPOST.")],
    /,
    *,
    dialect: DialectFlag = "auto",
    name: Annotated[str, Parameter(help="Id of the solver, and what the other ids begin with. Default: rtk, rover, base, ...")] = "",
    out: Annotated[Path | None, Parameter(help="The deployment file; one that is there is not replaced. Default: standard output.")] = None,
    secrets: Annotated[
        Path | None, Parameter(help="Write the passwords of the file there, as NAME=VALUE for the environment, readable by you alone.")
    ] = None,
    strict: Annotated[bool, Parameter(negative="", help="Write nothing where a line is not understood.")] = False,
    every: Annotated[
        bool, Parameter(name="--all", negative="", help="Report every key, also those that the file leaves to defaults.")
    ] = False,
    as_json: Json = False,
) -> int:
    """Translate a .conf file of RTKLIB into a deployment file, and report what became of every key.

    The report goes to standard error: keys whose wish rtkmesh does not fulfil, lines that RTKLIB passes over in silence, what is to be
    said in the environment (passwords, paths that are none). A file without streams (of rnx2rtkp) gives the one table [solver], for
    `rtkmesh solve --config`.

    Exit codes: 0 imported, 1 imported, but there are lines that RTKLIB does not understand either, 2 nothing written.
    """
    from rtkmesh_services.cli.conf_files import write_secrets
    from rtkmesh_services.cli.conf_report import print_report, report_json
    from rtkmesh_services.conf.conf_file import read_conf
    from rtkmesh_services.conf.importer import import_conf

    imported = import_conf(read_conf(file, dialect), _id(name))
    wrong = imported.conf.wrong
    if not (strict and wrong):
        _write(imported, out, as_json)
        if secrets is not None:
            write_secrets(secrets, imported.secrets)
    if as_json:
        _write_json(report_json(imported))
    else:
        print_report(imported, every=every)
    return (EXIT_USAGE if strict else EXIT_NOT_UNDERSTOOD) if wrong else EXIT_OK


def _id(name: str) -> str:
    from rtkmesh_schemas.keys import check_id

    return check_id(name) if name else ""


def _write(imported: "Imported", out: Path | None, as_json: bool) -> None:
    from rtkmesh_services.cli.conf_files import write_new

    if out is not None:
        write_new(out, imported.toml)
    elif not as_json:
        sys.stdout.write(imported.toml)


def _write_json(value: Any) -> None:
    sys.stdout.write(msgspec.json.encode(value).decode() + "\n")


app = App(name="conf", help="RTKLIB's .conf files in and out; what a file means; what differs between two.")
app.command(
    command_page(
        import_,
        """
        rtkmesh conf import rtkrcv.conf --out robot.toml
        rtkmesh conf import rtkrcv.conf --dialect 2.4 --name front --secrets robot.env --out robot.toml
        rtkmesh conf import rtkrcv.conf --json
        """,
        name="import",
    )
)
