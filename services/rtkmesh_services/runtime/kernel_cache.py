"""Where compiled kernels are kept: one folder per state of the sources that kernels depend on.

numba looks only at the file of a kernel when it decides whether its compiled form is still good, not at the kernels that it
calls, and the constants that it takes, from other files. A folder named by a hash of all files with kernels and all that these import
makes an old form impossible. A new folder takes over what is still good (kernel_reuse). This must be called before numba is imported.
"""

import os
import re
import stat
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from rtkmesh_services.runtime.kernel_reuse import hash_of, record_of, start_with_known

VARIABLE: Final = "NUMBA_CACHE_DIR"
_KERNEL: Final = b"@kernel"
_IMPORTED: Final = re.compile(rb"\n[ \t]*(?:from|import) +(rtkmesh[\w.]*)(?: +import +(\([^)]*|[^\n]*))?")  # five times as fast as ^ is
UNUSED_S: Final = 30 * 86400.0  # folders of other states that nobody has used for so long are removed


def use_kernel_cache() -> Path:
    """Point numba to the folder of this engine and return it; below NUMBA_CACHE_DIR if that is set, else in the user's cache."""
    assert "numba" not in sys.modules or os.environ.get(VARIABLE), "numba has chosen its folder already"
    state = engine_hash()
    given = os.environ.get(VARIABLE, "")
    folder = Path(given) if given.endswith(state) else (Path(given) if given else _user_folder()) / state
    try:
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
    except OSError:
        folder = _private_folder() / state
        folder.mkdir(exist_ok=True)
    record = record_of(folder, _root())
    if not record.exists():
        start_with_known(record, *_with_kernels())
    os.environ[VARIABLE] = str(folder)
    return folder


def engine_hash() -> str:
    """Return a name for the state of the engine's files that have kernels, and of all that they import."""
    texts = {name: path.read_bytes() for name, path in _sources().items()}
    return f"kernels-{hash_of({name: texts[name] for name in needed_by_kernels(texts)})}"


def _with_kernels() -> tuple[dict[str, Path], dict[str, str]]:
    """Return the file of each module with kernels, and a hash of it and of all that it imports."""
    sources = _sources()
    texts = {name: path.read_bytes() for name, path in sources.items()}
    with_kernels = [name for name, text in texts.items() if _KERNEL in text]
    hashes = {name: hash_of({other: texts[other] for other in needed_by_kernels(texts, [name])}) for name in with_kernels}
    return {name: sources[name] for name in with_kernels}, hashes


def _sources() -> dict[str, Path]:
    root = _root()
    return {module_of(path, root): path for path in root.rglob("*.py")}


def _root() -> Path:
    spec = find_spec("rtkmesh")
    assert spec is not None, "the engine is installed with the services"
    assert spec.origin is not None, "the engine is a package with an __init__"
    return Path(spec.origin).parent


def module_of(path: Path, root: Path) -> str:
    """Return the name of the module in a file below the folder of the engine."""
    parts = path.relative_to(root.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def needed_by_kernels(texts: Mapping[str, bytes], modules: Sequence[str] | None = None) -> set[str]:
    """Return the modules with kernels, or those named, and, of all that they import, the modules of the engine."""
    found: set[str] = set()
    todo = [name for name, text in texts.items() if _KERNEL in text] if modules is None else list(modules)
    while todo:
        name = todo.pop()
        if name in texts and name not in found:
            found.add(name)
            todo += _imports(texts[name])
    return found


def _imports(text: bytes) -> Iterator[str]:
    """Yield the modules that a source may import, with the packages around them."""
    for module, names in _IMPORTED.findall(b"\n" + text):
        parts = module.decode().split(".")
        yield from (".".join(parts[:n]) for n in range(1, len(parts) + 1))
        yield from (f"{module.decode()}.{name.strip()}" for name in names.decode().lstrip("(").split(","))


def forget_old(folder: Path) -> int:
    """Remove the folders of other states beside this one that have not been used for a month; return how many."""
    from shutil import rmtree  # noqa: PLC0415  every command starts with this module

    old = [path for path in folder.parent.glob("kernels-*") if path != folder and time.time() - path.stat().st_mtime > UNUSED_S]
    for path in old:
        rmtree(path, ignore_errors=True)
    return len(old)


def _private_folder() -> Path:
    """Return a folder for temporary files into which nobody else can write: compiled kernels are code that we run."""
    from tempfile import gettempdir, mkdtemp  # noqa: PLC0415  the exception; every command starts with this module

    folder = Path(gettempdir()) / f"rtkmesh-{os.getuid()}"
    folder.mkdir(exist_ok=True, mode=0o700)
    found = folder.lstat()
    ours = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022
    return folder if ours else Path(mkdtemp(prefix="rtkmesh-"))


def _user_folder() -> Path:
    base = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(base) if base else Path.home() / ".cache") / "rtkmesh"
