"""``rtkmesh conf``: RTKLIB's .conf files in and out; what a file means; what differs between two."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
from cyclopts import App, Parameter

from rtkmesh_services.cli.network import EXIT_OK, EXIT_USAGE, Json
from rtkmesh_services.cli.page import command_page

if TYPE_CHECKING:
    from rtkmesh_services.conf.effective import Setting
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

    Exit codes: 0 imported, 1 imported, but without lines that are not understood, 2 nothing written.
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


SolverFlag = Annotated[str, Parameter(help="Id of the solver; not needed where there is one.")]


def export(
    file: Annotated[Path, Parameter(help="A deployment file, or a file with one solver.")],
    /,
    *,
    solver: SolverFlag = "",
    dialect: Annotated[Literal["2.4", "demo5"], Parameter(help="Of RTKLIB 2.4.x, or of demo5 (RTKLIB EX).")] = "demo5",
    out: Annotated[Path | None, Parameter(help="The .conf file; one that is there is not replaced. Default: standard output.")] = None,
) -> int:
    """Write a solver of a deployment as a .conf file that RTKLIB runs with the same meaning.

    What RTKLIB has no word for stands in comments at the top. References to the environment stay what they are: RTKLIB wants the
    passwords themselves.

    Exit codes: 0 written, 2 a file that is wrong, or one in the way.
    """
    from rtkmesh_services.cli.conf_files import write_new
    from rtkmesh_services.conf.exporter import export_conf
    from rtkmesh_services.conf.unexpanded import load_unexpanded, one_solver

    deployment, _ = load_unexpanded(file)
    name, _ = one_solver(deployment, solver, str(file))
    text = export_conf(deployment, name, dialect, file.name)
    if out is not None:
        write_new(out, text)
    else:
        sys.stdout.write(text)
    return EXIT_OK


def show(
    file: Annotated[Path, Parameter(help="A deployment file, a file with one solver, or a .conf file of RTKLIB.")],
    /,
    *,
    solver: Annotated[str, Parameter(help="Id of a solver: only its values.")] = "",
    dialect: DialectFlag = "auto",
    as_json: Json = False,
) -> int:
    """Show every value that counts, and where it comes from: a line of the file, or the default. Secrets are masked.

    Exit codes: 0 shown, 2 a file that is wrong.
    """
    from rtkmesh_services.conf.effective import settings_of

    settings = [row for row in settings_of(file, dialect).values() if not solver or row.key.startswith(f"solver.{solver}.")]
    if solver and not settings:
        sys.stderr.write(f"rtkmesh conf: {file}: no [solver.{solver}]\n")
        return EXIT_USAGE
    if as_json:
        _write_json([msgspec.to_builtins(row) for row in settings])
        return EXIT_OK
    width = max((len(row.key) for row in settings), default=0)
    sys.stdout.writelines(f"{row.key:<{width}} = {_plain(row.value):<24} # {row.origin}\n" for row in settings)
    return EXIT_OK


def diff(
    one: Annotated[Path, Parameter(help="A deployment file, a file with one solver, or a .conf file of RTKLIB.")],
    other: Annotated[Path, Parameter(help="The other one, of any of these kinds.")],
    /,
    *,
    dialect: DialectFlag = "auto",
    as_json: Json = False,
) -> int:
    """Show the values that differ in what they do: defaults count, the order and wording of the files do not.

    Of files with one solver each its id does not count. Where one is of a solver alone, only solvers are compared.

    Exit codes: 0 the same, 1 different, 2 a file that is wrong.
    """
    from rtkmesh_services.conf.effective import comparable, differences

    rows = differences(*comparable(one, other, dialect))
    if as_json:
        _write_json([msgspec.to_builtins(row) for row in rows])
    else:
        sys.stdout.writelines(f"{row.key}\n  - {_side(row.one)}  ({one.name})\n  + {_side(row.other)}  ({other.name})\n" for row in rows)
    return EXIT_DIFFERENT if rows else EXIT_OK


def keys(
    *,
    write: Annotated[Path | None, Parameter(help="Write the page there (docs/reference/conf_keys.md). Default: standard output.")] = None,
) -> int:
    """Print what becomes of every key of RTKLIB's .conf files, as Markdown."""
    from rtkmesh_services.conf.reference import conf_keys_page

    if write is not None:
        write.write_text(conf_keys_page(), encoding="utf-8")
    else:
        sys.stdout.write(conf_keys_page())
    return EXIT_OK


def _side(setting: "Setting | None") -> str:
    return "not there" if setting is None else f"{_plain(setting.value)}  # {setting.origin}"


def _plain(value: Any) -> str:
    from rtkmesh_services.runtime.toml_text import toml_value

    return "nothing" if value is None else toml_value(value)


app = App(name="conf", help="RTKLIB's .conf files in and out; what a file means; what differs between two.")
for function, examples, name_ in (
    (
        import_,
        """
        rtkmesh conf import rtkrcv.conf --out robot.toml
        rtkmesh conf import rtkrcv.conf --dialect 2.4 --name front --secrets robot.env --out robot.toml
        rtkmesh conf import rtkrcv.conf --json
        """,
        "import",
    ),
    (export, "rtkmesh conf export robot.toml --solver rtk --dialect 2.4 --out rtkrcv.conf", "export"),
    (show, "rtkmesh conf show robot.toml --solver rtk", "show"),
    (diff, "rtkmesh conf diff rtkrcv.conf robot.toml", "diff"),
    (keys, "rtkmesh conf keys", "keys"),
):
    app.command(command_page(function, examples, name=name_))
