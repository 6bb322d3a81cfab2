"""All code in the README, the documentation, the docstrings and the examples is run."""

import doctest
import os
import re
import runpy
import shlex
import sys
from importlib import import_module
from pathlib import Path

import pytest
from fresh_python import said

from mr_damper_ros.__main__ import main

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "doc").glob("**/*.md"))]
SHOWN = ("identify", "import", "replay", "validate")
"""Commands that need no ROS and no files of another page."""


def blocks(language: str) -> list[tuple[Path, str]]:
    """The code blocks of a language on all pages that are not generated."""
    return [
        (page, code)
        for page in PAGES
        if page.parent.name != "generated"
        for code in re.findall(rf"```{language}\n(.*?)```", page.read_text("utf-8"), re.DOTALL)
    ]


def examples() -> list[str]:
    """Modules without ROS that have examples in their docstrings."""
    folder = ROOT / "mr_damper_ros"
    return [
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        for path in sorted(folder.rglob("*.py"))
        if ">>> " in path.read_text("utf-8") and "nodes" not in path.parts
    ]


WITHOUT_ROS = [(page, code) for page, code in blocks("python") if "mr.identify" in code]
COMMANDS = [block for block in blocks("bash") if "mr-damper " in block[1]]


@pytest.fixture
def clone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder in which paths of the clone are valid and files may be written."""
    for name in ("bags", "doc"):
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("module", examples())
def test_the_examples_of_the_docstrings_are_right(module: str) -> None:
    failed, tried = doctest.testmod(import_module(module))
    assert tried > 0
    assert failed == 0


def test_the_readme_goes_from_a_file_to_a_figure_in_six_lines(clone: Path) -> None:
    (code,) = [code for page, code in WITHOUT_ROS if page.name == "README.md"]
    assert len(code.replace("\n\n", "\n").splitlines()) == 6
    (clone / "shown.py").write_text(code)
    found = runpy.run_path("shown.py")
    assert found["result"].success
    assert (clone / "damper.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    "block", [b for b in WITHOUT_ROS if b[0].name != "README.md"], ids=lambda block: block[0].stem
)
def test_the_python_of_the_pages_runs(clone: Path, block: tuple[Path, str]) -> None:
    (clone / "shown.py").write_text(block[1])
    runpy.run_path("shown.py")


@pytest.mark.parametrize("page", sorted({page for page, _ in COMMANDS}), ids=lambda p: p.stem)
def test_the_commands_of_the_pages_run(clone: Path, page: Path) -> None:
    for _, code in (block for block in COMMANDS if block[0] == page):
        for line in code.replace("\\\n", " ").replace("/tmp/", f"{clone}/").splitlines():
            program, *arguments = shlex.split(line) or [""]
            if program == "mr-damper" and arguments[0] in SHOWN:
                assert main(arguments) == 0, line


def test_pages_link_to_what_is_there() -> None:
    missing = [
        f"{page.relative_to(ROOT)}: {target}"
        for page in PAGES
        if page.parent.name != "generated"
        for target in re.findall(r"\]\(([^)#:]+)[^)]*\)", page.read_text("utf-8"))
        if "generated/" not in target and not (page.parent / target).exists()
    ]
    assert missing == []


@pytest.mark.parametrize(
    "example", sorted((ROOT / "examples").glob("*.py")), ids=lambda path: path.stem
)
def test_an_example_runs(example: Path, tmp_path: Path) -> None:
    for folder in ("bags", "doc"):
        (tmp_path / folder).symlink_to(ROOT / folder)
    environment = {**os.environ, "MPLBACKEND": "agg", "PYTHONPATH": str(ROOT)}
    assert said(sys.executable, example, cwd=tmp_path, env=environment)
