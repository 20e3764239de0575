"""Compiled kernels live in a folder that no other state of the engine's sources uses."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import rtkmesh
from rtkmesh_services.runtime.kernel_cache import (
    UNUSED_S,
    VARIABLE,
    engine_hash,
    forget_old,
    module_of,
    needed_by_kernels,
    use_kernel_cache,
)


def test_the_folder_is_named_by_the_sources_and_given_on_as_it_is(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    folder = use_kernel_cache()
    assert folder == tmp_path / engine_hash()
    assert os.environ[VARIABLE] == str(folder)
    assert use_kernel_cache() == folder


def test_a_change_of_what_kernels_depend_on_means_another_folder(tmp_path: Path) -> None:
    """A file with a kernel, and what it imports however it says so, count; a file that no kernel needs does not."""
    files = {
        "__init__.py": "",
        "_jit.py": "# one\n",
        "gnss/__init__.py": "",
        "gnss/frames.py": "from rtkmesh._jit import kernel\nfrom rtkmesh.gnss import constants\n\n\n@kernel\ndef f(): ...\n",
        "gnss/constants.py": "from rtkmesh.gnss.deeper import (\n    A,\n)\n",
        "gnss/deeper.py": "A = 1\n",
        "gnss/words.py": "from rtkmesh.gnss.frames import f\n",
    }
    for name, text in files.items():
        path = tmp_path / "rtkmesh" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    program = "from rtkmesh_services.runtime.kernel_cache import engine_hash; print(engine_hash())"

    def name_of_state() -> str:
        environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
        return subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True).stdout

    states = [name_of_state()]
    assert states[0] == name_of_state()
    for name in ("_jit.py", "gnss/frames.py", "gnss/constants.py", "gnss/deeper.py"):
        (tmp_path / "rtkmesh" / name).write_text(files[name] + "# changed\n")
        states.append(name_of_state())
    assert len(set(states)) == len(states)
    (tmp_path / "rtkmesh/gnss/words.py").write_text("# changed\n")
    assert name_of_state() == states[-1]


def test_every_kernel_of_the_engine_counts() -> None:
    """What is compiled is in the hash: the modules of all kernels, and the constants that they take."""
    root = Path(rtkmesh.__file__).parent
    texts = {module_of(path, root): path.read_bytes() for path in root.rglob("*.py")}
    needed = needed_by_kernels(texts)
    assert {name for name, text in texts.items() if b"@kernel" in text} <= needed
    assert {"rtkmesh._jit", "rtkmesh.gnss.constants", "rtkmesh.rtk.solution"} <= needed
    assert not {"rtkmesh.attitude.design", "rtkmesh.attitude.filter", "rtkmesh.codecs.rinex_write"} & needed


def test_a_folder_that_cannot_be_made_is_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "/proc/nowhere")
    assert os.access(use_kernel_cache(), os.W_OK)


def test_a_folder_that_others_can_write_is_not_used(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Its kernels would be anybody's code."""
    monkeypatch.setenv(VARIABLE, "/proc/nowhere")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    usual = use_kernel_cache().parent
    assert usual == tmp_path / f"rtkmesh-{os.getuid()}"
    usual.chmod(0o777)
    monkeypatch.setenv(VARIABLE, "/proc/nowhere")
    other = use_kernel_cache().parent
    assert other != usual
    assert not other.stat().st_mode & 0o077


def test_only_folders_that_nobody_uses_are_forgotten(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    ours = use_kernel_cache()
    for name, age_s in (("kernels-old", UNUSED_S + 100.0), ("kernels-young", 100.0), ("other", UNUSED_S + 100.0)):
        folder = tmp_path / name
        folder.mkdir()
        stamp = folder.stat().st_mtime - age_s
        os.utime(folder, (stamp, stamp))
    assert forget_old(ours) == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([ours.name, "kernels-young", "other"])
