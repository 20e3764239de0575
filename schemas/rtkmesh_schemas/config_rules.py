"""``[rule.NAME]`` of the deployment file: what control does by itself when a value on the network crosses a limit."""

from typing import Annotated

import msgspec
from msgspec import Meta

Actions = Annotated[tuple[Annotated[str, Meta(min_length=1, max_length=500)], ...], Meta(max_length=16)]
Delay = Annotated[float, Meta(ge=0.0, le=86400.0)]


class RuleTable(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[rule.NAME]``: watches one field of the messages on ``key`` and gives commands when it begins to hold, and when it ends.

    ``key``: any key of the network, also of other programs (JSON, msgpack or plain text), or an expression such as
    ``rtk/*/status``: then every key that matches is watched for itself. ``when``: ``FIELD > 0.5`` (also >= < <= == !=; ``a.b.0``
    goes into maps and lists, ``value`` is a message that is one number or text), or ``silent``: no message for ``delay_s``. A limit
    that was crossed counts as crossed until the value has come back by ``hysteresis``. ``delay_s``: how long it must hold before
    the rule begins, ``end_delay_s``: before it ends. ``do`` and ``at_end`` are commands, ``OP ID [ARGUMENTS]``, where ID may
    have ``*`` and ``{id}`` is the process that the key belongs to; or ``event LEVEL TEXT``.
    """

    key: Annotated[str, Meta(min_length=1, max_length=200)]
    when: Annotated[str, Meta(min_length=1, max_length=200)]
    hysteresis: Annotated[float, Meta(ge=0.0, le=1e9)] = 0.0
    delay_s: Delay = 0.0
    end_delay_s: Delay = 0.0
    do: Actions = ()
    at_end: Actions = ()
    enabled: bool = True
