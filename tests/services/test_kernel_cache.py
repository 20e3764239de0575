"""Compiled kernels live in a folder that no other state of the engine's sources uses."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from rtkmesh_services.runtime.kernel_cache import UNUSED_S, VARIABLE, engine_hash, forget_old, use_kernel_cache


def test_the_folder_is_named_by_the_sources_and_given_on_as_it_is(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    folder = use_kernel_cache()
    assert folder == tmp_path / engine_hash()
    assert os.environ[VARIABLE] == str(folder)
    assert use_kernel_cache() == folder


def test_a_changed_kernel_of_another_file_means_another_folder(tmp_path: Path) -> None:
    """A copy of the engine with one changed comment has its own folder."""
    package = tmp_path / "rtkmesh" / "gnss"
    package.mkdir(parents=True)
    for name, text in (("rtkmesh/__init__.py", "__version__ = '0'\n"), ("rtkmesh/gnss/frames.py", "# one\n")):
        (tmp_path / name).write_text(text)
    program = "from rtkmesh_services.runtime.kernel_cache import engine_hash; print(engine_hash())"

    def name_of_state() -> str:
        environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
        return subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True).stdout

    before = name_of_state()
    assert before == name_of_state()
    (package / "frames.py").write_text("# two\n")
    assert name_of_state() != before


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
