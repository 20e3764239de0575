"""Who asked for what, and what became of it: every command but pure reads is an event ``command``, refused ones too."""

import re
from typing import Any, Final

from rtkmesh_schemas.command import Reply, Request
from rtkmesh_schemas.status import Level
from rtkmesh_services.runtime.logs import clean, masked
from rtkmesh_services.runtime.service import Context

READS: Final = frozenset(
    ("status", "help", "config", "metrics", "solution", "satellite", "observ", "navidata", "stream", "ssr", "error", "option")
)
_MAXIMUM_VALUES: Final = 16
_MAXIMUM_TEXT: Final = 200
_SECRET: Final = re.compile(r"passw|secret|token|credential|\bpw\b|_pw$|^pw_", re.IGNORECASE)


def note(context: Context, request: Request, reply: Reply, reads: frozenset[str] = READS) -> None:
    """Publish and log a command with its caller; one of ``reads`` is only logged, and only when all is logged."""
    caller, op = clean(request.caller[:_MAXIMUM_TEXT]), clean(request.op[:64])
    text = f"command {op or '(none)'} from {caller or 'unknown'}: {reply.code}"
    if request.op in reads:
        fields = {"caller": caller, "request_id": request.request_id, "code": reply.code.value}
        context.log.debug("%s", text, extra={"fields": fields})
        return
    context.event(
        Level.INFO if reply.ok else Level.WARNING,
        "command",
        text if reply.ok else f"{text}: {clean(reply.message[:_MAXIMUM_TEXT])}",
        caller=caller,
        op=op,
        result=reply.code.value,
        args=shown(request.args),
        request_id=clean(request.request_id),
    )


def shown(args: dict[str, Any]) -> dict[str, Any]:
    """Return arguments as others may see them: secrets masked, long ones clipped, not too many."""
    secret = any(isinstance(value, str) and _SECRET.search(value) for value in args.values())  # set key=console-passwd value=...
    found = {clean(name): "***" if _is_secret(name, secret_value=secret) else _clipped(value) for name, value in args.items()}
    return dict(list(found.items())[:_MAXIMUM_VALUES])


def _is_secret(name: str, *, secret_value: bool) -> bool:
    return _SECRET.search(name) is not None or (secret_value and name == "value")


def _clipped(value: Any) -> Any:
    if isinstance(value, (int, float, bool)) or value is None:
        return value
    text = masked(value) if isinstance(value, str) else str(masked(value))
    return text if len(text) <= _MAXIMUM_TEXT else f"{text[:_MAXIMUM_TEXT]}..."
