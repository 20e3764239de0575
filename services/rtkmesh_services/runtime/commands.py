"""The desk at ``rtk/{id}/cmd``: reads a question, sees to it that it is done once, answers in the asker's encoding.

Runs in the work loop. What every process can do is here; the rest goes to the role.
"""

import difflib
import logging
from collections.abc import Callable, Mapping
from typing import Final

import msgspec

from rtkmesh_schemas.command import Code, Reply, Request, request_of
from rtkmesh_schemas.command_limits import fault_of
from rtkmesh_schemas.errors import SchemaError
from rtkmesh_schemas.status import ServiceStatus
from rtkmesh_schemas.wire import JSON, MAXIMUM_COMMAND_BYTES, Wire, encode, encode_json, encoding_of
from rtkmesh_services.errors import CommandError, ServiceError
from rtkmesh_services.runtime.answers import Answers
from rtkmesh_services.runtime.audit import READS, note
from rtkmesh_services.runtime.bus import Query
from rtkmesh_services.runtime.faults import KEPT, SHOWN
from rtkmesh_services.runtime.logs import masked
from rtkmesh_services.runtime.service import Service, accepted, done, refused
from rtkmesh_services.runtime.solver_words import solver_of
from rtkmesh_services.runtime.words import clip

BASE_OPERATIONS: Final[Mapping[str, str]] = {
    "status": "the state with inputs, counters and latencies",
    "help": "what this process can do",
    "config": "this process's table of the deployment file, secrets masked",
    "metrics": "counters and latencies as flat numbers",
    "log": "level=debug|info|warning|error: set how much is logged; without level: tell",
    "error": "count=N: the newest warnings and errors of this process",
    "shutdown": "end the process (control starts it again unless it was told to stop it)",
}
STALE_NS: Final = 10_000_000_000  # a command is not done that was issued longer ago, or in the future, by more than this
_LOG_LEVELS: Final = ("debug", "info", "warning", "error")


class CommandDesk:
    """Answers the commands to one service. ``status`` gives the present status; ``end`` asks the loop to end."""

    def __init__(self, service: Service, status: Callable[[], ServiceStatus], end: Callable[[str], None]) -> None:
        self._service, self._status, self._end = service, status, end
        self._context = service.context
        self._answers = Answers()
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
            return self._unread(Code.TOO_LARGE, f"a command may have at most {MAXIMUM_COMMAND_BYTES} bytes")
        try:
            request = request_of(query.payload, query.encoding, query.parameters)
        except (SchemaError, ValueError, RecursionError) as error:
            return self._unread(Code.BAD_REQUEST, str(error))
        if fault := fault_of(request):
            return self._unread(Code.BAD_REQUEST, fault, request)
        request = self._folded(request)
        if (given := self._answers.find(request)) is not None:
            return given if given.code is not Code.CONFLICT else self._noted(request, given)
        reply = self._noted(request, self._late(request) or self._done(request))
        self._answers.keep(request, reply)
        return reply

    def _unread(self, code: Code, message: str, request: Request | None = None) -> Reply:
        """Refuse what is no command; what it seems to say is noted, no more than that."""
        seen = Request(op="") if request is None else msgspec.structs.replace(request, args={})
        return self._noted(seen, refused(code, message))

    def _noted(self, request: Request, reply: Reply) -> Reply:
        reply = msgspec.structs.replace(
            reply, request_id=request.request_id, id=self._context.id, state=reply.state or self._status().state.value
        )
        note(self._context, request, reply, READS | self._service.reads)
        return reply

    def _folded(self, request: Request) -> Request:
        """Return the request with the operation's name as we write it: Survey-In is survey_in."""
        known = {_fold(name): name for name in (*self._base, *self._service.operations)}
        name = known.get(_fold(request.op))
        return request if name is None or name == request.op else msgspec.structs.replace(request, op=name)

    def _late(self, request: Request) -> Reply | None:
        """Refuse a command whose time is over, or that was for a process that is not this one any more."""
        now_ns = self._context.clock.utc_ns()
        if request.expires_utc_ns and now_ns > request.expires_utc_ns:
            return refused(
                Code.STALE, f"it expired {(now_ns - request.expires_utc_ns) / 1e9:.3f} s ago by this host's clock: nothing is done"
            )
        if request.issued_utc_ns and abs(now_ns - request.issued_utc_ns) > STALE_NS:
            age_s = (now_ns - request.issued_utc_ns) / 1e9
            return refused(Code.STALE, f"it was issued {age_s:.3f} s ago by this host's clock, and counts for 10 s: nothing is done")
        if request.start_id and request.start_id != self._context.start_id:
            return refused(Code.STALE, f"it is for run {request.start_id[:64]!r} of this process, which is {self._context.start_id!r} now")
        return None

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
        near = difflib.get_close_matches(_fold(request.op), known, 1)
        hint = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(known)}"
        return refused(Code.UNKNOWN_OP, f"no operation {clip(request.op)!r}; {hint}")

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


def _fold(name: str) -> str:
    return name.strip().lower().replace("-", "_")


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
