"""``[telnet.ID]`` of the deployment file: RTKRCV's console over telnet."""

from typing import Annotated

import msgspec
from msgspec import Meta


class TelnetTable(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[telnet.ID]``: RTKRCV's console over telnet for one solver: its words, prompts and layouts, for scripts that were written for it.

    ``listen`` is ``HOST:PORT``; beyond this host it needs ``password`` (``"${RTKMESH_TELNET_PASSWORD}"``: secrets come from the
    environment). Telnet is not encrypted. ``allow_shutdown``: the word ``shutdown``, typed in full, stops the solver's process.
    ``idle_s``: who says nothing for so long is logged out, 0: never.
    """

    solver: Annotated[str, Meta(min_length=1, max_length=64)]
    listen: Annotated[str, Meta(max_length=260)] = "127.0.0.1:8023"
    password: Annotated[str, Meta(max_length=200)] = ""
    allow_shutdown: bool = False
    idle_s: Annotated[float, Meta(ge=0.0, le=86400.0)] = 1800.0
    maximum_clients: Annotated[int, Meta(ge=1, le=32)] = 32
