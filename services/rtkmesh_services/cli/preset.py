"""``rtkmesh preset``: the base stations of a running network: which there are, how good they are, which is used."""

import json
import sys
from typing import Annotated, Any

from cyclopts import App, Parameter

from rtkmesh_schemas.command import Reply
from rtkmesh_schemas.keys import CONTROL_ID
from rtkmesh_services.cli.network import DEFAULT_ENDPOINT, EXIT_OK, EXIT_USAGE, Connect, Json, Namespace, exit_code, reach
from rtkmesh_services.cli.page import command_page

Solver = Annotated[str, Parameter(help="Only for this solver; without: for all.")]
Name = Annotated[str, Parameter(help="The preset's id.")]
Fields = Annotated[str, Parameter(name="--fields", help="Further fields as a JSON object, named as in the deployment file.")]


def list_(*, as_json: Json = False, connect: Connect = DEFAULT_ENDPOINT, namespace: Namespace = "") -> int:
    """Show the base stations that can be selected, with score and state of those that run.

    Exit codes: 0 done, 1 failed, 3 not reachable, 124 no answer in time.
    """
    reply = _ask(connect, namespace, "list")
    presets: list[dict[str, Any]] = reply.data.get("presets", [])
    more = reply
    while more.ok and "next" in more.data:
        more = _ask(connect, namespace, "list", first=more.data["next"])
        presets += more.data.get("presets", [])
    if as_json or not reply.ok:
        return _say(reply, as_json=as_json)
    if not presets:
        sys.stdout.write("no presets: [preset.NAME] in the deployment file, `rtkmesh preset add`, or a receiver on a serial port\n")
        return EXIT_OK
    _print(presets)
    for solver, name in reply.data["solvers"].items():
        sys.stdout.write(f"{solver} has a selection of its own: {name or 'none'}\n")
    return EXIT_OK


def show(name: Name, /, *, connect: Connect = DEFAULT_ENDPOINT, namespace: Namespace = "") -> int:
    """Show a preset with its score and what that is made of, as JSON.

    Exit codes: 0 done, 1 there is none, 3 not reachable, 124 no answer in time.
    """
    reply = _ask(connect, namespace, "show", id=name)
    if reply.ok:
        sys.stdout.write(json.dumps(reply.data["preset"], indent=2) + "\n")
        return EXIT_OK
    return _say(reply, as_json=False)


def select(
    name: Annotated[str, Parameter(help="The preset's id; none: no base station.")],
    /,
    *,
    solver: Solver = "",
    follow: Annotated[bool, Parameter(negative="", help="End the solver's own selection: that for all counts again.")] = False,
    as_json: Json = False,
    connect: Connect = DEFAULT_ENDPOINT,
    namespace: Namespace = "",
) -> int:
    """Select a base station while everything runs, for all solvers or for one.

    The old one is used until the new one delivers. Exit codes: 0 accepted, 1 there is none, 3 not reachable, 124 no answer in time.
    """
    if follow:
        return _say(_ask(connect, namespace, "follow", solver=solver), as_json=as_json)
    return _say(_ask(connect, namespace, "select", id="" if name == "none" else name, solver=solver), as_json=as_json)


def add(
    name: Name,
    /,
    *source: Annotated[str, Parameter(help="Where its stream comes from, and what to fall back on.")],
    title: Annotated[str, Parameter(help="Its name for people.")] = "",
    standby: Annotated[bool, Parameter(negative="", help="Let it run also while another one is selected.")] = False,
    fields: Fields = "",
    as_json: Json = False,
    connect: Connect = DEFAULT_ENDPOINT,
    namespace: Namespace = "",
) -> int:
    """Make a preset; `rtkmesh preset save` keeps it for the next start.

    Exit codes: 0 done, 2 wrong usage, 3 not reachable, 124 no answer in time.
    """
    given = _fields(fields)
    if given is None:
        return EXIT_USAGE
    told = {"sources": list(source), **({"title": title} if title else {}), **({"standby": True} if standby else {}), **given}
    return _say(_ask(connect, namespace, "new", id=name, fields=told), as_json=as_json)


def update(name: Name, /, *, fields: Fields, as_json: Json = False, connect: Connect = DEFAULT_ENDPOINT, namespace: Namespace = "") -> int:
    """Change fields of a preset that was made by a user.

    Exit codes: 0 done, 1 there is none, 2 wrong usage, 3 not reachable, 4 it is not a user's, 124 no answer in time.
    """
    given = _fields(fields)
    return EXIT_USAGE if given is None else _say(_ask(connect, namespace, "update", id=name, fields=given), as_json=as_json)


def remove(name: Name, /, *, as_json: Json = False, connect: Connect = DEFAULT_ENDPOINT, namespace: Namespace = "") -> int:
    """Forget a preset that was made by a user; where it is selected, none is from then on.

    Exit codes: 0 done, 1 there is none, 3 not reachable, 4 it is not a user's, 124 no answer in time.
    """
    return _say(_ask(connect, namespace, "delete", id=name), as_json=as_json)


def save(*, as_json: Json = False, connect: Connect = DEFAULT_ENDPOINT, namespace: Namespace = "") -> int:
    """Keep the presets that users have made for the next start.

    Exit codes: 0 done, 1 they cannot be written, 3 not reachable, 124 no answer in time.
    """
    return _say(_ask(connect, namespace, "save"), as_json=as_json)


def _ask(connect: str, namespace: str, action: str, **arguments: Any) -> Reply:
    from rtkmesh_services.runtime.calls import call

    with reach(connect, namespace) as bus:
        return call(bus, CONTROL_ID, "preset", {"action": action, **arguments})[0]


def _say(reply: Reply, *, as_json: bool) -> int:
    if as_json:
        from rtkmesh_schemas.wire import encode_json

        sys.stdout.write(encode_json(reply).decode() + "\n")
    elif reply.ok:
        sys.stdout.write(f"{reply.message}\n")
    else:
        sys.stderr.write(f"rtkmesh preset: {reply.message}\n")
    return exit_code([reply])


def _fields(text: str) -> dict[str, Any] | None:
    """Return the fields in a JSON text; None after having said what is wrong."""
    try:
        found = json.loads(text or "{}")
    except ValueError as error:
        found = error
    if not isinstance(found, dict):
        sys.stderr.write(f"rtkmesh preset: --fields wants a JSON object such as '{{\"standby\": true}}', not {text[:100]!r}\n")
        return None
    return {str(name): value for name, value in found.items()}  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]  any JSON


def _print(presets: list[dict[str, Any]]) -> None:
    from rtkmesh_services.cli.plain_table import print_table

    heads = ("", "preset", "title", "type", "score", "weakest", "distance km", "state", "used by", "source")
    print_table(heads, [_cells(preset) for preset in presets], right=("score", "distance km"))


def _cells(preset: dict[str, Any]) -> tuple[str, ...]:
    runs, distance_m = bool(preset["state"]), preset["distance_m"]
    return (
        "*" if preset["selected"] else "",
        preset["id"],
        preset["title"] if preset["title"] != preset["id"] else "",
        preset["type"],
        f"{preset['score']:.2f}" if runs else "",
        preset["weakest"],
        "" if distance_m is None else f"{distance_m / 1e3:.1f}",
        f"{preset['state']} {preset['reason']}".strip() or ("standby" if preset["standby"] else ""),
        ", ".join(preset["used_by"]),
        preset["sources"][0],
    )


app = App(name="preset", help="The base stations of a running network: which there are, how good they are, which is used.")
for function, example, name_ in (
    (list_, "rtkmesh preset list", "list"),
    (show, "rtkmesh preset show near", "show"),
    (select, "rtkmesh preset select near\nrtkmesh preset select far --solver rtk\nrtkmesh preset select none", "select"),
    (add, "rtkmesh preset add roof ntrip://user:pw@caster:2101/ROOF --standby", "add"),
    (update, 'rtkmesh preset update roof --fields \'{"title": "Roof"}\'', "update"),
    (remove, "rtkmesh preset remove roof", "remove"),
    (save, "rtkmesh preset save", "save"),
):
    app.command(command_page(function, example, name=name_))
