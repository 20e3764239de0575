"""Compiled kernels of another state of the engine that are still good: only what a change touches is compiled again.

Every folder of compiled kernels tells, in ``modules-PLACE.json``, a hash of each module with kernels and of all that it imports. An engine
that comes to a folder, from whatever place, starts with the compiled kernels of the modules whose hash is the same there or in another
folder, as hard links: numba replaces files and never writes into one. numba itself compares the text of each kernel's own file, so a wrong
guess of where it keeps what costs time only.
"""

import json
import os
from collections.abc import Iterator, Mapping
from hashlib import blake2b, sha1
from pathlib import Path
from typing import Final, cast

_RECORDS: Final = "modules-*.json"


def record_of(folder: Path, engine: Path) -> Path:
    """Return the file that tells, in a folder of compiled kernels, that the engine at a place has come to it."""
    return folder / f"modules-{sha1(str(engine.resolve()).encode(), usedforsecurity=False).hexdigest()[:12]}.json"


def start_with_known(record: Path, sources: Mapping[str, Path], hashes: Mapping[str, str]) -> int:
    """Fill the folder of a record with what is known of other places and states, write the record, return how many modules came along.

    Args:
        record: see record_of.
        sources: the file of each module with kernels.
        hashes: of each module with kernels and of all that it imports.

    """
    folder, missing = record.parent, dict(hashes)
    for other in _folders(folder):
        known = _record(other)
        for module in [name for name, text in missing.items() if known.get(name) == text]:
            if _link(other, folder / numba_folder(sources[module]), sources[module]):
                del missing[module]
    record.write_text(json.dumps(dict(hashes), indent=1))
    return len(hashes) - len(missing)


def hash_of(texts: Mapping[str, bytes]) -> str:
    """Return a hash of modules and their names, in any order."""
    digest = blake2b(digest_size=8)
    for name in sorted(texts):
        digest.update(name.encode() + b"\0" + texts[name])
    return digest.hexdigest()


def numba_folder(source: Path) -> str:
    """Return the name of the folder in which numba keeps the kernels of a file, below its cache."""
    folder = str(source.resolve().parent)
    return f"{source.resolve().parent.name}_{sha1(folder.encode(), usedforsecurity=False).hexdigest()}"


def _folders(folder: Path) -> Iterator[Path]:
    """Yield the folders that have a record, this one or the last used first."""
    found = {path.parent for path in folder.parent.glob(f"kernels-*/{_RECORDS}")}
    yield from sorted(found, key=lambda path: (path == folder, path.stat().st_mtime), reverse=True)


def _record(folder: Path) -> dict[str, str]:
    try:
        told = cast("object", json.loads(next(folder.glob(_RECORDS)).read_text()))
    except (OSError, ValueError, StopIteration):
        return {}
    return cast("dict[str, str]", told) if isinstance(told, dict) else {}


def _link(other: Path, target: Path, source: Path) -> int:
    """Link all that another folder has of a file's kernels, wherever that file lay then; return how many files."""
    count = 0
    for path in other.glob(f"{source.parent.name}_*/{source.stem}.*"):
        target.mkdir(exist_ok=True)
        try:
            os.link(path, target / path.name)
        except OSError:  # it is there already, or the other folder has just been removed
            continue
        count += 1
    return count
