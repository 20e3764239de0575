"""``[flockwave]``: what Skybrush clients speak to."""

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

Address = Annotated[str, Meta(max_length=260)]


class FlockwaveTable(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[flockwave]``: Flockwave messages by TCP (a line each) and UDP (a datagram each), at ``HOST:PORT``; empty: not.

    Skybrush clients look for port 5001. Beyond this host only with ``insecure``: the protocol has no password. ``set``: which messages of a
    base count as forwarded: basic (as for corrections) or full. The queryable ``rtk/flockwave`` is there in any case.
    """

    tcp: Address = ""
    udp: Address = ""
    insecure: bool = False
    set: Literal["basic", "full"] = "basic"
    maximum_clients: Annotated[int, Meta(ge=1, le=1000)] = 64
