"""After a change only the kernels that depend on it are compiled again."""

import os
import subprocess
import sys
from pathlib import Path

from rtkmesh_services.runtime.kernel_cache import VARIABLE
from rtkmesh_services.runtime.kernel_reuse import numba_folder, record_of, start_with_known

FILES = {
    "__init__.py": "",
    "_jit.py": "import numba\nkernel = numba.njit(cache=True)\n",
    "below.py": "from rtkmesh._jit import kernel\n\n\n@kernel\ndef one() -> int:\n    return 1\n",
    "above.py": "from rtkmesh._jit import kernel\nfrom rtkmesh.below import one\n\n\n@kernel\ndef two() -> int:\n    return one() + 1\n",
    "beside.py": "from rtkmesh._jit import kernel\n\n\n@kernel\ndef three() -> int:\n    return 3\n",
}
PROGRAM = """
from rtkmesh_services.runtime.kernel_cache import use_kernel_cache
use_kernel_cache()
from rtkmesh.above import two
from rtkmesh.below import one
from rtkmesh.beside import three
print(one(), two(), three(), *[sum(f.stats.cache_hits.values()) for f in (one, two, three)])
"""


def write_engine(folder: Path) -> None:
    for name, text in FILES.items():
        path = folder / "rtkmesh" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def run(engine: Path, cache: Path) -> list[int]:
    """Return what the three kernels give, and how many of each came compiled from the disk."""
    environment = {**os.environ, "PYTHONPATH": str(engine), VARIABLE: str(cache), "NUMBA_DISABLE_JIT": "0"}
    answer = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=True)
    return [int(word) for word in answer.stdout.split()]


def test_a_change_costs_what_depends_on_it_wherever_the_engine_lies(tmp_path: Path) -> None:
    here, there, cache = tmp_path / "here", tmp_path / "there", tmp_path / "cache"
    write_engine(here)
    assert run(here, cache)[3:] == [0, 0, 0]
    assert run(here, cache)[3:] == [1, 1, 1]
    (here / "rtkmesh/above.py").write_text(FILES["above.py"].replace("+ 1", "+ 10"))
    assert run(here, cache) == [1, 11, 3, 1, 0, 1]
    (here / "rtkmesh/below.py").write_text(FILES["below.py"].replace("return 1", "return 5"))
    assert run(here, cache) == [5, 15, 3, 0, 0, 1]
    write_engine(there)
    assert run(there, cache) == [1, 2, 3, 1, 1, 1]


def test_a_record_that_is_damaged_is_as_none(tmp_path: Path) -> None:
    source = tmp_path / "engine" / "a.py"
    for name, record in (("kernels-1", "{"), ("kernels-2", "[]"), ("kernels-3", '{"a": "good"}')):
        kept = tmp_path / name / numba_folder(source)
        kept.mkdir(parents=True)
        (kept / "a.f-1.py311.nbi").write_text(name)
        (tmp_path / name / "modules-1.json").write_text(record)
    new = tmp_path / "kernels-new"
    new.mkdir()
    assert start_with_known(record_of(new, source.parent), {"a": source}, {"a": "good"}) == 1
    assert (new / numba_folder(source) / "a.f-1.py311.nbi").read_text() == "kernels-3"
