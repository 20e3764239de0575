"""The answers that have been given, by request id: a command is done once, however often it is asked. Bounded in number and bytes."""

from collections import OrderedDict
from dataclasses import dataclass
from typing import Final

import msgspec

from rtkmesh_schemas.command import Code, Reply, Request
from rtkmesh_services.runtime.service import refused

MAXIMUM_ANSWERS: Final = 256
MAXIMUM_ANSWER_BYTES: Final = 1 << 20


@dataclass(frozen=True, slots=True)
class _Given:
    content: bytes
    reply: Reply
    size: int


class Answers:
    """What was answered to which request. Who uses an id again for something else does not get the answer of the first."""

    def __init__(self, maximum: int = MAXIMUM_ANSWERS, maximum_bytes: int = MAXIMUM_ANSWER_BYTES) -> None:
        self._given: OrderedDict[str, _Given] = OrderedDict()
        self._maximum, self._maximum_bytes = maximum, maximum_bytes
        self.bytes = 0

    def __len__(self) -> int:
        return len(self._given)

    def find(self, request: Request) -> Reply | None:
        """Return the answer that the request has had, a refusal if its id is that of another command, or None."""
        given = self._given.get(request.request_id) if request.request_id else None
        if given is None:
            return None
        if given.content != _content(request):
            reply = refused(Code.CONFLICT, "the request_id is that of another command: take a new one for each")
            return msgspec.structs.replace(reply, request_id=request.request_id)
        return given.reply

    def keep(self, request: Request, reply: Reply) -> None:
        """Remember an answer; the oldest ones go for it. One that is larger than all of the memory is not kept."""
        if not request.request_id:
            return
        content = _content(request)
        size = len(content) + len(msgspec.msgpack.encode(reply))
        if size > self._maximum_bytes:
            return
        self._given[request.request_id] = _Given(content, reply, size)
        self.bytes += size
        while len(self._given) > self._maximum or self.bytes > self._maximum_bytes:
            self.bytes -= self._given.popitem(last=False)[1].size


def _content(request: Request) -> bytes:
    """Return what makes a command the same: what is to be done, for whom, on which run; when it was said does not matter."""
    return msgspec.msgpack.encode((request.op, request.args, request.caller, request.start_id), order="sorted")
