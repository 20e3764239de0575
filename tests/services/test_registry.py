"""What is kept of a deployment on disk: one control, what is wanted, what runs."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtkmesh_schemas.keys import Role
from rtkmesh_services.control.adoption import sort_out
from rtkmesh_services.control.fleet import LaunchOptions, ProcessSpec, specs_of
from rtkmesh_services.control.memory import Memory
from rtkmesh_services.control.registry import DeploymentFolder, Desired, HeldError, ProcessEntry, Running, folder_of, own_identity
from rtkmesh_services.runtime.configuration import load_site, parse_deployment
from rtkmesh_services.runtime.host_processes import Identity

IDS = st.sampled_from(["rover", "base", "rtk"])
TEXT = '[deployment]\nname = "my robot/1"\n[monitor.one]\n'


def entry(id_: str, definition: str = "x", identity: Identity | None = None) -> ProcessEntry:
    return ProcessEntry(id=id_, role=Role.SOLVER, definition=definition, identity=identity)


def test_there_is_one_control_and_the_second_is_told_who(tmp_path: Path) -> None:
    first, second = DeploymentFolder(tmp_path / "robot-1"), DeploymentFolder(tmp_path / "robot-1")
    assert not first.is_held()
    first.hold()
    first.write_running(Running(name="robot", control=own_identity()))
    assert second.is_held()
    with pytest.raises(
        HeldError, match=rf"robot-1 has a control already, pid {os.getpid()} .*rtkmesh cmd control reload.*rtkmesh down robot-1"
    ):
        second.hold()
    first.release()
    second.hold()
    second.release()


def test_a_dead_control_holds_nothing(tmp_path: Path) -> None:
    """The lock is the kernel's: no stale one can be left behind."""
    script = (
        "import os, sys; from pathlib import Path; from rtkmesh_services.control.registry import DeploymentFolder;"
        "folder = DeploymentFolder(Path(sys.argv[1])); folder.hold(); os.kill(os.getpid(), 9)"
    )
    assert subprocess.run([sys.executable, "-c", script, str(tmp_path)], check=False).returncode == -9
    folder = DeploymentFolder(tmp_path)
    assert not folder.is_held()
    folder.hold()
    folder.release()


@pytest.mark.parametrize("damage", [b"", b"{", b"[" * 100_000, b'{"processes": {"a": 3}}', b'{"stopped": 7}', b"\xff" * 100])
def test_damaged_files_are_as_none(tmp_path: Path, damage: bytes) -> None:
    for name in ("processes.json", "desired.json"):
        (tmp_path / name).write_bytes(damage)
    folder = DeploymentFolder(tmp_path)
    assert (folder.running(), folder.desired()) == (Running(), Desired())


@given(st.lists(st.tuples(IDS, st.sampled_from(["start", "stop", "forget", "solve", "rest", "table"])), max_size=20))
def test_the_last_word_counts(words: list[tuple[str, str]]) -> None:
    """Whatever came before: each process is wanted as it was last told, each solver told as it was last seen."""
    desired = Desired()
    stopped: set[str] = set()
    solvers: dict[str, bool] = {}
    for id_, word in words:
        if word in ("start", "stop"):
            desired = desired.with_process(id_, wanted=word == "start")
            (stopped.discard if word == "start" else stopped.add)(id_)
        elif word == "forget":
            desired = desired.without({id_})
            stopped.discard(id_)
            solvers.pop(id_, None)
        else:
            running = {"solve": True, "rest": False, "table": None}[word]
            desired = desired.with_solver(id_, running)
            solvers.pop(id_, None)
            if running is not None:
                solvers[id_] = running
    assert (desired.stopped, desired.solvers) == (stopped, solvers)


def test_what_is_wanted_comes_back_unless_it_is_forgotten(tmp_path: Path) -> None:
    folder = DeploymentFolder(tmp_path)
    memory = Memory(folder)
    memory.desired = Desired().with_process("rover", wanted=False).with_solver("rtk", running=False)
    assert memory.is_new
    memory.write([entry("rtk", identity=own_identity())])
    assert not memory.is_new
    assert Memory(folder).desired == Desired(stopped=frozenset({"rover"}), solvers={"rtk": False})
    assert list(Memory(folder).left.alive) == ["rtk"]
    fresh = Memory(folder, fresh=True)
    assert fresh.desired == Desired()
    fresh.end()
    assert (folder.desired(), folder.running().processes) == (Desired(), {})


def test_a_folder_that_cannot_be_written_costs_the_memory_only(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("no folder")
    memory = Memory(DeploymentFolder(tmp_path / "a"))
    memory.write([entry("rtk")])
    memory.write([entry("rover")])
    assert memory.errors == 2


def test_one_folder_for_each_name_file_and_namespace(tmp_path: Path) -> None:
    """What makes a deployment another one; the name of the folder is for people."""
    made: list[str] = []
    for name, text in (
        ("a", TEXT),
        ("b", TEXT),
        ("a", TEXT.replace("robot", "boat")),
        ("a", TEXT.replace("[mon", 'namespace = "v1"\n[mon')),
    ):
        (tmp_path / f"{name}.toml").write_text(text)
        made.append(folder_of(load_site(tmp_path / f"{name}.toml")).folder.name)
    assert len(set(made)) == 4
    assert made[0].startswith("my_robot_1-")
    (tmp_path / "a.toml").write_text(TEXT + "[monitor.two]\n")
    assert folder_of(load_site(tmp_path / "a.toml")).folder.name == made[0]


def test_the_definition_is_of_tables_and_command_and_not_of_the_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another control has another environment; that is no reason to restart a solver."""

    def definitions(text: str, **options: str) -> dict[str, str]:
        specs = specs_of(parse_deployment(text, "x.toml"), LaunchOptions(Path("/x.toml"), **options))
        return {spec.id: spec.definition for spec in specs}

    text = "[monitor.one]\n[monitor.two]\n"
    before = definitions(text)
    monkeypatch.setenv("SSH_CLIENT", "another")
    assert definitions(text) == before
    changed = definitions(text.replace("[monitor.two]", "[monitor.two]\nperiod_s = 2.0"))
    assert [id_ for id_ in before if changed[id_] != before[id_]] == ["two"]
    assert all(definitions(text, python="/other")[id_] != before[id_] for id_ in before)


def test_what_was_left_is_sorted_out() -> None:
    """Kept only when it is alive and what is wanted; a process that ended by command is no loss."""
    spec = ProcessSpec("kept", Role.SOLVER, ("x",))
    specs = [spec, replace(spec, id="changed"), replace(spec, id="ended"), replace(spec, id="stopped"), replace(spec, id="new")]
    who = own_identity()
    entries = {
        "kept": entry("kept", spec.definition, who),
        "changed": entry("changed", "other", who),
        "ended": entry("ended", spec.definition, replace(who, start_ticks=1)),
        "stopped": entry("stopped", spec.definition),
        "removed": entry("removed", spec.definition, who),
    }
    found = sort_out(entries, Running(processes=entries).alive, specs)
    assert list(found.running) == ["kept", "changed", "removed"]
    assert found.in_words() == "taken over: kept; changed: changed; not wanted: removed; ended meanwhile: ended"
