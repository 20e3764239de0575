"""What a recording tells in its first minutes, known from its first epoch on: whoever logged it was switched on before."""

from collections.abc import Hashable, Iterable, Iterator
from typing import Final

from rtkmesh.codecs.messages import Message
from rtkmesh.gnss.ephemeris import GlonassEphemeris, KeplerEphemeris, KlobucharParameters, ReferenceStation
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.session import EndOfStream, Source

Item = tuple[Source, Message | EndOfStream]

AHEAD_S: Final = 120.0  # satellites repeat their ephemerides every 30 s, bases theirs and their position within two minutes


def looking_ahead(items: Iterable[Item]) -> Iterator[Item]:
    """Yield the messages of recordings; before them the first ephemeris of each satellite, ionosphere and base position that come within
    AHEAD_S of the rover's first epoch.
    """
    items, held = iter(items), list[Item]()
    first: GpsTime | None = None
    for source, message in items:
        held.append((source, message))
        if source is Source.ROVER and isinstance(message, Epoch):
            first = first or message.time
            if message.time - first > AHEAD_S:
                break
    yield from _firsts(held)
    yield from held
    yield from items


def _firsts(held: list[Item]) -> Iterator[Item]:
    """Yield the first of everything that was in force before it was told."""
    seen = set[Hashable]()
    for source, message in held:
        kind = _lasting(source, message)
        if kind is not None and kind not in seen:
            seen.add(kind)
            yield source, message


def _lasting(source: Source, message: Message | EndOfStream) -> Hashable | None:
    """Return what a message says, None if it says nothing that was so before."""
    if isinstance(message, KeplerEphemeris):
        return message.satellite, message.message
    if isinstance(message, GlonassEphemeris):
        return message.satellite
    if isinstance(message, KlobucharParameters):
        return "ionosphere", message.system
    if isinstance(message, ReferenceStation) and message.position_ecef_m is not None:
        return "station", source
    return None
