"""The bus inside one process: for tests of services. Synchronous, in order, with caches, queries and liveliness.

All buses of one ``MemoryNetwork`` see each other. A publish calls the subscribers before it returns; a ``get`` returns the
answers that were given until then, or runs ``on_wait`` (one step of the services under test) until all have answered.
"""

import re
from collections import defaultdict, deque
from collections.abc import Callable
from dataclasses import dataclass, field

from rtkmesh_schemas.keys import LIVE, Kind, Stream, live_key
from rtkmesh_services.runtime.bus import Answer, Bus, Handle, Liveliness, Query, Sample, guarded, live_of
from rtkmesh_services.runtime.clock import Clock

_PATIENCE = 1000  # steps of ``on_wait`` until a question counts as timed out


def matches(expression: str, key: str) -> bool:
    """Return whether a key matches a key expression (``*``: one chunk, ``**``: any number; neither matches ``@`` chunks)."""
    pattern = ""
    for chunk in expression.split("/"):
        if chunk == "**":
            pattern += r"(?:[^/@][^/]*/)*"
        else:
            pattern += re.escape(chunk).replace(r"\*", "(?!@)[^/]*") + "/"
    return re.fullmatch(pattern, key + "/") is not None


@dataclass(slots=True)
class MemoryNetwork:
    """What the buses of a test share. ``on_wait`` lets the asked services work while a ``get`` waits."""

    clock: Clock = field(default_factory=Clock)
    on_wait: Callable[[], None] | None = None
    subscribers: list[tuple[str, Callable[[Sample], None]]] = field(default_factory=list[tuple[str, Callable[[Sample], None]]])
    queryables: list[tuple[str, Callable[[Query], None]]] = field(default_factory=list[tuple[str, Callable[[Query], None]]])
    watchers: list[Callable[[Liveliness], None]] = field(default_factory=list[Callable[[Liveliness], None]])
    tokens: list[str] = field(default_factory=list[str])
    caches: dict[str, deque[Sample]] = field(default_factory=lambda: defaultdict[str, deque[Sample]](deque))
    sent: list[Sample] = field(default_factory=list[Sample])


class MemoryBus(Bus):
    """A bus of a ``MemoryNetwork``; see ``Bus`` for the contract."""

    def __init__(self, id: str, network: MemoryNetwork | None = None) -> None:  # noqa: A002  the word of the design
        super().__init__(id)
        self.network = network or MemoryNetwork()
        self._handles: list[_Undo] = []
        self.closed = False

    def sent(self, stream: Stream, **fields: str) -> list[Sample]:
        """Return what this bus has published on a stream: for a test's asserts."""
        key = self._key(self.id, stream, fields)
        return [sample for sample in self.network.sent if sample.key == key]

    def matched(self, stream: Stream, **fields: str) -> bool:
        """See ``Bus``."""
        key = self._key(self.id, stream, fields)
        return any(matches(expression, key) for expression, _ in self.network.subscribers)

    def subscribe(self, expression: str, on_sample: Callable[[Sample], None], *, history: bool = False) -> Handle:
        """See ``Bus``."""
        entry = (expression, guarded(self, on_sample))
        if history:
            for key, cache in self.network.caches.items():
                for sample in tuple(cache) if matches(expression, key) else ():
                    entry[1](sample)
        self.network.subscribers.append(entry)
        return self._keep(lambda: self.network.subscribers.remove(entry))

    def queryable(self, key: str, on_query: Callable[[Query], None]) -> Handle:
        """See ``Bus``."""
        entry = (key, guarded(self, on_query))
        self.network.queryables.append(entry)
        return self._keep(lambda: self.network.queryables.remove(entry))

    def get(self, selector: str, *, payload: bytes = b"", encoding: str = "", timeout_s: float) -> list[Answer]:  # noqa: ARG002  time stands still here
        """See ``Bus``; ``timeout_s`` is not waited for: steps of the network's ``on_wait`` are."""
        expression, _, parameters = selector.partition("?")
        asked = [(key, on_query) for key, on_query in tuple(self.network.queryables) if matches(expression, key)]
        answers: list[list[Answer]] = [[] for _ in asked]
        for (key, on_query), answer in zip(asked, answers, strict=True):
            on_query(_MemoryQuery(key, payload, encoding, parameters, answer))
        for _ in range(_PATIENCE):
            if self.network.on_wait is None or all(answers):
                break
            self.network.on_wait()
        return [answer[0] if answer else Answer(False, "", b"Timeout", "", timed_out=True) for answer in answers]

    def live_token(self, role: str, id: str) -> Handle:  # noqa: A002
        """See ``Bus``."""
        key = live_key(role, id)
        self.network.tokens.append(key)
        self._tell(Liveliness(role, id, alive=True))

        def take_back() -> None:
            self.network.tokens.remove(key)
            if key not in self.network.tokens:
                self._tell(Liveliness(role, id, alive=False))

        return self._keep(take_back)

    def live(self, timeout_s: float = 1.0) -> dict[str, str]:  # noqa: ARG002  time stands still here
        """See ``Bus``."""
        names = [live_of(key) for key in self.network.tokens if matches(LIVE.expression(), key)]
        return {name[1]: name[0] for name in names if name is not None}

    def on_live(self, callback: Callable[[Liveliness], None]) -> Handle:
        """See ``Bus``."""
        watcher = guarded(self, callback)
        for id, role in self.live().items():  # noqa: A001
            watcher(Liveliness(role, id, alive=True))
        self.network.watchers.append(watcher)
        return self._keep(lambda: self.network.watchers.remove(watcher))

    def connected(self) -> bool:
        """See ``Bus``."""
        return not self.closed

    def neighbours(self) -> int:
        """See ``Bus``."""
        return int(not self.closed)

    def close(self) -> None:
        """See ``Bus``."""
        self.closed = True
        for handle in self._handles:
            handle.close()

    def _put(self, key: str, stream: Stream, payload: bytes, encoding: str, attachment: bytes | None) -> None:
        if self.closed:
            self.counters["not_sent"] += 1
            return
        sample = Sample(key, payload, encoding, attachment or b"", self.network.clock.mono_ns())
        self.network.sent.append(sample)
        if stream.kind is Kind.CACHED:
            cache = self.network.caches[key]
            cache.append(sample)
            while len(cache) > stream.cache:
                cache.popleft()
        for expression, on_sample in tuple(self.network.subscribers):
            if matches(expression, key):
                on_sample(sample)

    def _tell(self, change: Liveliness) -> None:
        for watcher in tuple(self.network.watchers):
            watcher(change)

    def _keep(self, take_back: Callable[[], None]) -> "_Undo":
        handle = _Undo(take_back)
        self._handles.append(handle)
        return handle


class _Undo(Handle):
    def __init__(self, take_back: Callable[[], None]) -> None:
        self._take_back: Callable[[], None] | None = take_back

    def close(self) -> None:
        """Undo the declaration."""
        take_back, self._take_back = self._take_back, None
        if take_back is not None:
            take_back()


class _MemoryQuery(Query):
    def __init__(self, key: str, payload: bytes, encoding: str, parameters: str, answers: list[Answer]) -> None:
        super().__init__(key, payload, encoding, parameters)
        self._answers = answers

    def _send(self, payload: bytes, encoding: str, *, error: bool) -> None:
        self._answers.append(Answer(not error, "" if error else self.key, payload, encoding))
