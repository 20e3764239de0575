"""Words for errors: the nearest right name, foreign text made harmless."""

import difflib
from collections.abc import Iterator


def nearest(name: str, among: Iterator[str] | list[str]) -> str:
    """Return `; did you mean 'x'?` or nothing."""
    names = list(among)
    found = difflib.get_close_matches(name, names, 1, 0.5)
    parts = [known for known in names if len(name) >= 3 and (name in known.split("_") or known.startswith(name))]
    best = (parts or found)[:1]
    return f"; did you mean {best[0]!r}?" if best else ""


def clip(text: str) -> str:
    """Return foreign text short and printable, for an error."""
    return "".join(character if character.isprintable() else "�" for character in text[:100])
