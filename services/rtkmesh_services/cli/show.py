"""``rtkmesh keys`` and ``rtkmesh schema``: the reference of the wire."""

import sys
from pathlib import Path
from typing import Annotated

import msgspec
from cyclopts import Parameter

from rtkmesh_schemas.keys import STREAMS
from rtkmesh_services.cli.network import EXIT_OK, EXIT_USAGE, Json
from rtkmesh_services.cli.page import command_page


def keys(
    *, markdown: Annotated[bool, Parameter(negative="", help="Print the page docs/reference/keys.md.")] = False, as_json: Json = False
) -> int:
    """Print the table of all keys: who owns them, what is on them, how often."""
    from rtkmesh_schemas.reference import keys_page

    if markdown:
        sys.stdout.write(keys_page())
    elif as_json:
        rows = [{name: getattr(stream, name) for name in stream.__slots__} for stream in STREAMS]
        sys.stdout.write(msgspec.json.encode(rows).decode() + "\n")
    else:
        width = max(len(stream.template) for stream in STREAMS)
        for stream in STREAMS:
            sys.stdout.write(f"{stream.template:<{width}}  {stream.kind.value:<20}  {stream.type:<17}  {stream.content}\n")
    return EXIT_OK


def schema(
    name: Annotated[str, Parameter(help="A message's name, or Deployment; without it: the names.")] = "",
    /,
    *,
    write: Annotated[Path | None, Parameter(help="Write all schemas and keys.md into this folder (docs/reference).")] = None,
) -> int:
    """Print the JSON Schema of a message or of the deployment file (Deployment)."""
    from rtkmesh_schemas.reference import SCHEMAS, json_schema_text, reference_pages
    from rtkmesh_services.runtime.words import nearest

    if write is not None:
        for page, text in reference_pages().items():
            (write / page).parent.mkdir(parents=True, exist_ok=True)
            (write / page).write_text(text)
        return EXIT_OK
    if not name:
        sys.stdout.write("\n".join(SCHEMAS) + "\n")
        return EXIT_OK
    if name not in SCHEMAS:
        sys.stderr.write(f"rtkmesh schema: no message {name!r}{nearest(name, list(SCHEMAS))}\n")
        return EXIT_USAGE
    sys.stdout.write(json_schema_text(name))
    return EXIT_OK


keys_app = command_page(
    keys,
    """
    rtkmesh keys
    rtkmesh keys --json
    """,
)

schema_app = command_page(
    schema,
    """
    rtkmesh schema
    rtkmesh schema SolutionMessage
    rtkmesh schema Deployment > deployment.schema.json
    """,
)
