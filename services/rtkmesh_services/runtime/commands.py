"""The desk at ``rtk/{id}/cmd``: reads a question, sees to it that it is done once, answers in the asker's encoding.

Runs in the work loop. What every process can do is here; the rest goes to the role.
"""

import difflib
import logging
from collections import OrderedDict
from collections.abc import Callable, Mapping
from typing import Final

import msgspec

from rtkmesh_schemas.command import Code, Reply, Request, request_of
from rtkmesh_schemas.errors import SchemaError
from rtkmesh_schemas.status import ServiceStatus
from rtkmesh_schemas.wire import JSON, MAXIMUM_COMMAND_BYTES, Wire, encode, encode_json, encoding_of
from rtkmesh_services.errors import CommandError, ServiceError
from rtkmesh_services.runtime.bus import Query
from rtkmesh_services.runtime.faults import KEPT, SHOWN
from rtkmesh_services.runtime.logs import masked
from rtkmesh_services.runtime.service import Service, accepted, done, refused
from rtkmesh_services.runtime.solver_words import solver_of

BASE_OPERATIONS: Final[Mapping[str, str]] = {
    "status": "the state with inputs, counters and latencies",
    "help": "what this process can do",
    "config": "this process's table of the deployment file, secrets masked",
    "metrics": "counters and latencies as flat numbers",
    "log": "level=debug|info|warning|error: set how much is logged; without level: tell",
    "error": "count=N: the newest warnings and errors of this process",
    "shutdown": "end the process (control starts it again unless it was told to stop it)",
}
_REMEMBERED: Final = 256
_LOG_LEVELS: Final = ("debug", "info", "warning", "error")


class CommandDesk:
    """Answers the commands to one service. ``status`` gives the present status; ``end`` asks the loop to end."""

    def __init__(self, service: Service, status: Callable[[], ServiceStatus], end: Callable[[str], None]) -> None:
        self._service, self._status, self._end = service, status, end
        self._context = service.context
        self._answers: OrderedDict[str, Reply] = OrderedDict()
        self._base: dict[str, Callable[[Request], Reply]] = {
            "status": self._tell_status,
            "help": self._tell_help,
            "config": self._tell_config,
            "metrics": self._tell_metrics,
            "log": self._set_log,
            "error": self._tell_errors,
            "shutdown": self._shut_down,
        }
        self.opened = False
        self.counters = {"commands": 0, "commands_refused": 0}

    def answer(self, query: Query) -> None:
        """Answer one query, whatever it holds."""
        reply = self._reply(query)
        reply = msgspec.structs.replace(reply, id=self._context.id, state=reply.state or self._status().state.value)
        self.counters["commands"] += 1
        if reply.ok:
            query.reply(*encoded_as_asked(reply, query))
        else:
            self.counters["commands_refused"] += 1
            query.reply_error(*encoded_as_asked(reply, query))

    def busy(self, query: Query) -> None:
        """Answer a query that had to leave the queue."""
        query.reply_error(*encoded_as_asked(refused(Code.FAILED, "too many commands wait"), query))

    def _reply(self, query: Query) -> Reply:
        if len(query.payload) > MAXIMUM_COMMAND_BYTES or len(query.parameters) > MAXIMUM_COMMAND_BYTES:
            return refused(Code.TOO_LARGE, f"a command may have at most {MAXIMUM_COMMAND_BYTES} bytes")
        try:
            request = request_of(query.payload, query.encoding, query.parameters)
        except (SchemaError, ValueError, RecursionError) as error:
            return refused(Code.BAD_REQUEST, str(error))
        if request.request_id and request.request_id in self._answers:
            return self._answers[request.request_id]
        reply = msgspec.structs.replace(self._done(request), request_id=request.request_id)
        self._log(request, reply)
        if request.request_id:
            self._answers[request.request_id] = reply
            while len(self._answers) > _REMEMBERED:
                self._answers.popitem(last=False)
        return reply

    def _done(self, request: Request) -> Reply:
        try:
            if request.op in self._service.operations:
                if not self.opened:
                    return refused(Code.WRONG_STATE, "still warming up; try again in a moment")
                return self._service.command(request)
            if request.op in self._base:
                return self._base[request.op](request)
        except CommandError as error:
            return refused(error.code, str(error))
        except (ServiceError, SchemaError) as error:
            return refused(Code.FAILED, str(error))
        except Exception as error:
            self._context.log.exception("command %s failed", request.op)
            return refused(Code.FAILED, f"internal error: {type(error).__name__}: {error}")
        if place := solver_of(request.op, self._context):
            return refused(Code.UNKNOWN_OP, place)
        known = sorted({*self._base, *self._service.operations})
        near = difflib.get_close_matches(request.op[:64], known, 1)
        hint = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(known)}"
        return refused(Code.UNKNOWN_OP, f"no operation {request.op[:64]!r}; {hint}")

    def _log(self, request: Request, reply: Reply) -> None:
        level = logging.DEBUG if request.op in {"status", "metrics", "help"} else logging.INFO
        fields = {"caller": request.caller, "request_id": request.request_id, "code": reply.code.value}
        self._context.log.log(
            level, "command %s from %s: %s", request.op[:64], request.caller or "unknown", reply.code, extra={"fields": fields}
        )

    def _tell_status(self, request: Request) -> Reply:  # noqa: ARG002  the operations share one form
        status = self._status()
        screen, details = self._service.status_screen(status) if self.opened else ("", {})
        reply = done(status.reason or status.state.value, **msgspec.to_builtins(status), **details)
        return msgspec.structs.replace(reply, text=screen)

    def _tell_help(self, request: Request) -> Reply:  # noqa: ARG002
        operations = {**BASE_OPERATIONS, **self._service.operations}
        reply = done("operations", operations=operations)
        return msgspec.structs.replace(reply, text="".join(f"{name:<22s}: {meaning}\n" for name, meaning in operations.items()))

    def _tell_config(self, request: Request) -> Reply:  # noqa: ARG002
        table = masked(msgspec.to_builtins(self._service.table()))
        return done("configuration", table=table, config_hash=self._context.config_hash)

    def _tell_metrics(self, request: Request) -> Reply:  # noqa: ARG002
        return done("metrics", values=metric_values(self._status()))

    def _tell_errors(self, request: Request) -> Reply:
        faults, count = self._context.faults, request.args.get("count", SHOWN)
        if isinstance(count, bool) or not str(count).isdecimal() or not 0 < int(str(count)[:6]) <= KEPT:
            raise CommandError(Code.BAD_ARGUMENTS, f"count is a whole number from 1 to {KEPT}, not {str(count)[:64]!r}")
        newest = faults.newest(int(str(count)))
        reply = done(f"{faults.total} errors and warnings", total=faults.total, errors=[msgspec.to_builtins(fault) for fault in newest])
        return msgspec.structs.replace(reply, text="".join(f"{fault.line}\n" for fault in newest))

    def _set_log(self, request: Request) -> Reply:
        root = logging.getLogger()
        level = request.args.get("level")
        if level is not None:
            if level not in _LOG_LEVELS:
                raise CommandError(Code.BAD_ARGUMENTS, f"level is one of {', '.join(_LOG_LEVELS)}, not {str(level)[:64]!r}")
            root.setLevel(level.upper())
        return done(f"log level is {logging.getLevelName(root.level).lower()}", level=logging.getLevelName(root.level).lower())

    def _shut_down(self, request: Request) -> Reply:
        self._end(f"shutdown by {request.caller or 'a command'}")
        return accepted("shutting down")


def encoded_as_asked(reply: Wire, query: Query) -> tuple[bytes, str]:
    """Return (payload, encoding) of a reply: msgpack for a msgpack question, else JSON, which people read."""
    if wants_msgpack(query):
        return encode(reply), encoding_of(type(reply))
    return encode_json(reply), encoding_of(type(reply), JSON)


def wants_msgpack(query: Query) -> bool:
    """Return whether the question came as msgpack (then its first byte is that of a map)."""
    return not query.encoding.startswith(JSON) and bool(query.payload) and query.payload[0] >= 0x80


def metric_values(status: ServiceStatus) -> dict[str, float]:
    """Return the numbers of a status: counters, quantiles and input ages under flat names."""
    values: dict[str, float] = {name: float(count) for name, count in status.counters.items()}
    for name, quantiles in status.latencies_ms.items():
        for part in ("p50", "p95", "p99", "maximum"):
            values[f"{name}_{part}_ms"] = getattr(quantiles, part)
    for row in status.inputs:
        values[f"input_{row.name}_messages"] = float(row.messages)
        if row.age_s is not None:
            values[f"input_{row.name}_age_s"] = row.age_s
    values["uptime_s"] = status.uptime_s
    return values
