"""What README and docs show is true: commands parse, deployment files pass the check, links lead somewhere, keys are in the table."""

import re
import shlex
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rtkmesh_schemas.keys import stream_of
from rtkmesh_services.cli.check import check
from rtkmesh_services.cli.main import COMMANDS, application

REPOSITORY = Path(__file__).resolve().parents[2]
PAGES = [REPOSITORY / "README.md", REPOSITORY / "benchmarks" / "README.md", *sorted((REPOSITORY / "docs").rglob("*.md"))]
MADE = {REPOSITORY / "docs" / "reference" / name for name in ("keys.md", "conf_keys.md")}  # generated, have tests of their own

# What the fragments of how-tos refer to.
SURROUNDINGS = {
    **{f"ingest.{name}": 'source = "tcp://127.0.0.1:1"' for name in ("rover", "base", "front", "rear")},
    "solver.rtk": 'rover = "rover"\nbase = "base"',
    "solver.heading_rtk": 'rover = "front"\nbase = "rear"\nmode = "moving-base"',
    "attitude.heading": 'solver = "heading_rtk"',
}


def blocks(language: str) -> list[Any]:
    """Return the fenced blocks of a language in all pages, named by page and number."""
    return [
        pytest.param(text, id=f"{page.relative_to(REPOSITORY)}-{number}")
        for page in PAGES
        for number, text in enumerate(re.findall(rf"(?ms)^```{language}\n(.*?)^```", page.read_text()))
    ]


def command_lines() -> list[str]:
    """Return the lines that a reader types."""
    lines = [line[2:] for block in blocks("console") for line in block.values[0].splitlines() if line.startswith("$ ")]
    return sorted({part.strip() for line in lines for part in line.split("&&")})


def code_words() -> Iterator[tuple[Path, str]]:
    """Yield what stands in backticks within the text."""
    for page in (page for page in PAGES if page not in MADE):
        text = re.sub(r"(?ms)^```.*?^```", "", page.read_text())
        yield from ((page, word) for word in re.findall(r"`([^`\n]+)`", text))


@pytest.mark.parametrize("line", [line for line in command_lines() if line.startswith("rtkmesh ")])
def test_command_lines_parse(line: str):
    """Every subcommand, flag and value that is shown is one that the command takes; shipped files that are named exist."""
    words = shlex.split(line)[1:]
    application(words[0]).parse_args(words, exit_on_error=False, print_error=False)
    assert all((REPOSITORY / word).is_file() for word in words if word.startswith("config/"))


def test_the_pages_show_commands():
    """The test above would pass on pages without any."""
    shown = {line.split()[1] for line in command_lines() if line.startswith("rtkmesh ")}
    assert shown >= {"solve", "up", "check", "echo", "cmd", "status", "top"}


def test_commands_in_the_text_exist():
    """``rtkmesh NAME`` in backticks names a subcommand, ``make NAME`` a target."""
    targets = set(re.findall(r"(?m)^([a-z]+):", (REPOSITORY / "Makefile").read_text()))
    lines = [(page, word) for page, word in code_words()] + [(REPOSITORY, line) for line in command_lines()]
    unknown = [
        (page.name, text)
        for page, text in lines
        for program, name in re.findall(r"^(rtkmesh|make) ([a-z]+)", text)
        if name not in (COMMANDS if program == "rtkmesh" else targets)
    ]
    assert unknown == []


@pytest.mark.parametrize("text", blocks("toml"))
def test_deployment_files_pass_the_check(text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """Every deployment that is shown is right, in the surroundings that its page takes for granted."""
    monkeypatch.chdir(tmp_path)
    for name in re.findall(r"\$\{(\w+)\}", text):
        monkeypatch.setenv(name, "x")
    for path in re.findall(r'source = "file://([^"?]+)', text):
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        Path(path).touch()
        Path(f"{path}.tag").touch()
    missing = {name: body for name, body in SURROUNDINGS.items() if f"[{name}]" not in text}
    file = tmp_path / "shown.toml"
    file.write_text(text + "".join(f"\n[{name}]\n{body}\n" for name, body in missing.items()))
    assert check(file) == 0, capsys.readouterr().err


@pytest.mark.parametrize("text", blocks("python"))
def test_python_compiles(text: str):
    """The programs that are shown are Python."""
    compile(text, "shown.py", "exec")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_links_lead_somewhere(page: Path):
    """Relative links name files of the repository, and headings that are there."""
    for target, _, heading in (link.partition("#") for link in re.findall(r"\]\(([^)]+)\)", page.read_text())):
        if "://" in target:
            continue
        path = (page.parent / target).resolve() if target else page
        assert path.exists(), f"{page.name}: {target}"
        titles = re.findall(r"(?m)^#+ (.*)$", path.read_text()) if heading else []
        assert not heading or heading in {re.sub(r"[^a-z0-9 -]", "", title.lower()).replace(" ", "-") for title in titles}


def test_keys_in_the_text_are_in_the_table():
    """``rtk/ID/...`` in backticks is a key of the table: capitals stand for any id."""
    keys = [(page.name, re.split(r"[?\s]", word)[0]) for page, word in code_words() if word.startswith("rtk/") and not word.endswith(".py")]
    keys = [(page, re.sub(r"[A-Z]+|\*", "x", key)) for page, key in keys if "..." not in key and key not in ("rtk/", "rtk/sol")]
    assert len(keys) > 5
    assert [key for key in keys if stream_of(key[1]) is None] == []


def test_the_readme_has_its_block_of_results():
    """`benchmarks/accuracy.py --markdown` finds where its table goes."""
    assert len(re.findall(r"(?s)<!-- results -->\n.*?<!-- /results -->", (REPOSITORY / "README.md").read_text())) == 1


def test_the_unit_is_one_that_systemd_takes(tmp_path: Path):
    """systemd finds no fault in the unit once the programs are where it says."""
    if shutil.which("systemd-analyze") is None:
        pytest.skip("no systemd-analyze here")
    text = (REPOSITORY / "deploy" / "systemd" / "rtkmesh@.service").read_text()
    assert text.count("/opt/rtkmesh/bin/rtkmesh ") == 4
    unit = tmp_path / "rtkmesh@robot.service"
    unit.write_text(text.replace("/opt/rtkmesh/bin/rtkmesh", shutil.which("true") or "/bin/true"))
    done = subprocess.run(["systemd-analyze", "verify", str(unit)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_the_image_copies_what_is_there():
    """Every source of a COPY in the Dockerfile is in the repository."""
    lines = re.findall(r"(?m)^COPY (?!--from)(.*)$", (REPOSITORY / "deploy" / "Dockerfile").read_text())
    sources = [word for line in lines for word in line.split()[:-1]]
    assert sources
    assert all((REPOSITORY / word).exists() for word in sources)
