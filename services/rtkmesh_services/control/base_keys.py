"""``rtk/control/preset/{name}``: each preset answers on a key of its own; a get tells it, a command in it acts on it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import msgspec

from rtkmesh_schemas.command import Code, Reply, request_of
from rtkmesh_schemas.errors import SchemaError
from rtkmesh_schemas.keys import CONTROL_ID, PRESET
from rtkmesh_services.control.base_words import PresetDesk
from rtkmesh_services.errors import CommandError
from rtkmesh_services.runtime.bus import Handle, Query
from rtkmesh_services.runtime.commands import encoded_as_asked
from rtkmesh_services.runtime.service import Context, refused

ACTIONS: Final = ("show", "select", "update", "delete")


@dataclass(frozen=True, slots=True)
class PresetQuestion:
    """A question to a preset's key, on its way into the work loop."""

    name: str
    query: Query


def declare_with(context: Context, lane: str) -> Callable[[str], Handle]:
    """Return the function that makes the key of a preset answered, from the work loop."""

    def declare(name: str) -> Handle:
        def hand_over(query: Query) -> None:
            context.inbox.put(PresetQuestion(name, query), lane=lane)

        return context.bus.queryable(PRESET.key(CONTROL_ID, name=name), hand_over)

    return declare


def answer(desk: PresetDesk, question: PresetQuestion, context: Context) -> None:
    """Answer a question, whatever it holds."""
    reply = _reply(desk, question, context)
    encoded = encoded_as_asked(msgspec.structs.replace(reply, id=CONTROL_ID), question.query)
    if reply.ok:
        question.query.reply(*encoded)
    else:
        question.query.reply_error(*encoded)


def _reply(desk: PresetDesk, question: PresetQuestion, context: Context) -> Reply:
    query = question.query
    try:
        if not query.payload and "op=" not in query.parameters:
            return desk.act("show", {"id": question.name})
        request = request_of(query.payload, query.encoding, query.parameters)
        if request.op not in ACTIONS:
            return refused(Code.UNKNOWN_OP, f"a preset can be asked to {', '.join(ACTIONS)}")
        context.log.info("preset %s: %s from %s", question.name, request.op, request.caller or "unknown")
        reply = desk.act(request.op, {**request.args, "id": question.name})
        return msgspec.structs.replace(reply, request_id=request.request_id)
    except CommandError as error:
        return refused(error.code, str(error))
    except (SchemaError, ValueError, RecursionError) as error:
        return refused(Code.BAD_REQUEST, str(error))
