"""``rtkmesh receiver``: setting up receivers by recipes."""

import sys
import threading
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
from cyclopts import App, Parameter

from rtkmesh_services.cli.network import EXIT_FAILED, EXIT_OK, EXIT_REFUSED, EXIT_UNREACHABLE, Json
from rtkmesh_services.cli.page import command_page

if TYPE_CHECKING:
    from rtkmesh_services.ingest.receivers.configure import Outcome, Row
    from rtkmesh_services.ingest.receivers.recipes import Recipe
    from rtkmesh_services.ingest.wires import Wire

_WORDS = {True: "ok", False: "WRONG", None: "not read back"}


def configure(
    *,
    source: Annotated[str, Parameter(help="The receiver, as in a deployment file: serial://... or tcp://...")] = "",
    recipe: Annotated[str, Parameter(help="A recipe's name (see `rtkmesh receiver recipes`), or a file.")],
    port: Annotated[str, Parameter(help="What the receiver calls its port to us: USB, UART1, COM1 ...; guessed if not said.")] = "",
    save: Annotated[bool, Parameter(negative="", help="Let the receiver keep it without power.")] = False,
    force: Annotated[bool, Parameter(negative="", help="Also tell a receiver that is not one of the recipe's.")] = False,
    dry_run: Annotated[bool, Parameter(negative="", help="Show what would be said; open nothing.")] = False,
    as_json: Json = False,
) -> int:
    """Set up a receiver by a recipe: every step is told and acknowledged, then read back and compared.

    The port must not be in use: stop the ingest first (`rtkmesh cmd control stop id=rover`).

    Exit codes: 0 all is set, 1 something is not, 2 wrong usage, 3 the receiver is not there or does not answer, 4 another model.
    """
    from rtkmesh_services.errors import SourceError
    from rtkmesh_services.ingest.receivers.configure import configure as set_up
    from rtkmesh_services.ingest.receivers.configure import orders_of
    from rtkmesh_services.ingest.receivers.recipes import load_recipe

    found = load_recipe(recipe, port, source)
    if dry_run:
        _show_orders(found, orders_of(found, save=save), as_json=as_json)
        return EXIT_OK
    if not source:
        raise SourceError("--source says which receiver; `rtkmesh ports` shows what there is")
    wire = open_wire(source)
    try:
        outcome = set_up(wire, found, save=save, force=force, say=_say)
    except (SourceError, OSError) as error:
        sys.stderr.write(f"rtkmesh receiver configure: {error}\n")
        return EXIT_UNREACHABLE
    finally:
        wire.close()
    _show(found, outcome, as_json=as_json)
    return EXIT_OK if outcome.ok else EXIT_FAILED if outcome.fits else EXIT_REFUSED


def _say(what: str) -> None:
    sys.stderr.write(f"{what}\n")


def open_wire(source: str) -> "Wire":
    """Return the open port or connection of a source; SourceError says why there is none, or that it is none of these."""
    from rtkmesh_services.errors import SourceError, UnreachableError
    from rtkmesh_services.ingest.serial_ports import SerialPort
    from rtkmesh_services.ingest.urls import parse_source
    from rtkmesh_services.ingest.wires import TcpClient

    url = parse_source(source)
    opener = {"serial": SerialPort, "tcp": TcpClient}.get(url.scheme)
    if opener is None:
        raise SourceError(f"{source!r}: a receiver is set up at serial:// or tcp://")
    try:
        wire = opener(url).open(threading.Event())
    except (SourceError, OSError) as error:
        raise UnreachableError(str(error)) from error
    assert wire is not None, "nobody stops it"
    return wire


def recipes(*, as_json: Json = False) -> int:
    """Show the recipes that are shipped."""
    from rtkmesh_services.ingest.receivers.recipes import load_recipe, shipped_recipes

    found = [load_recipe(name) for name in shipped_recipes()]
    if as_json:
        rows = [{"name": recipe.name, "title": recipe.title, "language": recipe.language, "models": recipe.models} for recipe in found]
        _write_json(rows)
    else:
        _print(("recipe", "for", "what"), [(recipe.name, ", ".join(recipe.models), recipe.title) for recipe in found])
    return EXIT_OK


def _show_orders(recipe: "Recipe", orders: list[tuple[str, str]], *, as_json: bool) -> None:
    if as_json:
        _write_json({"recipe": recipe.name, "dry_run": True, "orders": [{"step": step, "said": said} for step, said in orders]})
    else:
        _print(("step", "would be said"), orders)


def _show(recipe: "Recipe", outcome: "Outcome", *, as_json: bool) -> None:
    if as_json:
        _write_json({"recipe": recipe.name, "ok": outcome.ok, **msgspec.to_builtins(outcome)})
        return
    sys.stdout.write(f"{outcome.identity}\n")
    if not outcome.fits:
        sys.stderr.write(f"not one of {', '.join(recipe.models)}: nothing was told (--force tells it)\n")
        return
    _print(("step", "setting", "wanted", "answer", "read back", ""), [_cells(row) for row in outcome.rows])
    if outcome.saved is not None:
        sys.stdout.write("saved\n" if outcome.saved else "NOT saved\n")


def _cells(row: "Row") -> tuple[str, ...]:
    return row.step, row.setting, row.wanted if row.wanted != row.setting else "", row.answer, row.read, _WORDS[row.ok]


def _write_json(value: Any) -> None:
    sys.stdout.write(msgspec.json.encode(value).decode() + "\n")


def _print(heads: tuple[str, ...], rows: list[Any]) -> None:
    from rtkmesh_services.cli.plain_table import print_table

    print_table(heads, rows)


app = App(name="receiver", help="Set up receivers.")
app.command(
    command_page(
        configure,
        """
        rtkmesh receiver configure --source serial:///dev/ttyACM0 --recipe f9p_rover
        rtkmesh receiver configure --source 'serial://0403:6015?baud=auto' --recipe um982 --save --json
        rtkmesh receiver configure --recipe f9p_base --port UART1 --dry-run
        """,
    )
)
app.command(command_page(recipes, "rtkmesh receiver recipes"))
