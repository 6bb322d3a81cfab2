"""Every command of the documentation names existing programs, options and files.

What needs no installed ROS is run in test/core/test_documentation.py and below.
"""

import os
import re
import shlex
import signal
import subprocess
from contextlib import suppress
from functools import cache
from pathlib import Path

import launch_stand_in
import pytest
from mr_damper_msgs.msg import PredictedForce
from support import Listener, installed_programs

from mr_damper_ros.nodes.bridge_node import BridgeParameters
from mr_damper_ros.nodes.campaign_node import CampaignParameters
from mr_damper_ros.nodes.controller_node import ControllerParameters
from mr_damper_ros.nodes.identifier_node import IdentifierParameters
from mr_damper_ros.nodes.live_node import LiveParameters
from mr_damper_ros.nodes.model_node import ModelParameters
from mr_damper_ros.nodes.quality import OVERRIDES, objection
from mr_damper_ros.nodes.replay_node import ReplayParameters
from mr_damper_ros.nodes.supply_node import SupplyParameters
from mr_damper_ros.nodes.suspension_node import SuspensionParameters
from mr_damper_ros.processes.programs import Program
from mr_damper_ros.settings.option_table import options

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "bags" / "README.md", *sorted((ROOT / "doc").glob("**/*.md"))]
PAGES = [page for page in PAGES if page.parent.name != "generated"]
SHARE = "$(ros2 pkg prefix --share mr_damper_ros)/"

TABLES: dict[str, type] = {
    "bridge": BridgeParameters,
    "campaign": CampaignParameters,
    "controller": ControllerParameters,
    "identifier": IdentifierParameters,
    "live": LiveParameters,
    "model": ModelParameters,
    "replay": ReplayParameters,
    "supply": SupplyParameters,
    "suspension": SuspensionParameters,
}

OTHERS = {"cd", "ln", "colcon", "rosdep", ".", "export", "for", "done", "kill", "sudo"}
"""First words of commands that this package cannot check."""


def commands(page: Path) -> list[str]:
    """Commands of a page: lines of its shell blocks and indented lines."""
    text = page.read_text(encoding="utf-8")
    shell = "".join(re.findall(r"```bash\n(.*?)```", text, re.DOTALL))
    text = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    for block in re.findall(r"\n\n((?: {4}.*\n)+)", text):
        if re.match(r" {4}(ros2|mr-damper|make|export|cd|\.) ", block):
            shell += re.sub(r"^ {4}", "", block, flags=re.MULTILINE)
    lines = shell.replace("\\\n", " ").splitlines()
    return [line.partition(" # ")[0].strip() for line in lines if line.strip()]


ALL = [(page, line) for page in PAGES for line in commands(page)]


def check_path(path: str) -> None:
    """Assert that a path exists, if it is one of the repository."""
    if path.startswith(("bags/", "doc/", "config/")):
        assert (ROOT / path).exists(), path


def check_node(node: str, arguments: list[str]) -> None:
    known = {item.name: item for item in options(TABLES[node])}
    assert arguments[:1] in ([], ["--ros-args"])
    for flag, value in zip(arguments[1::2], arguments[2::2], strict=True):
        assert flag in ("-p", "-r", "--params-file", "--enclave"), flag
        if flag != "-p":
            continue
        name, _, text = value.partition(":=")
        if name.startswith(OVERRIDES):
            assert objection(name, int(text) if text.isdigit() else text) == ""
            continue
        item = known[name]
        if item.kind is str:
            assert item.objection(text) == ""
        check_path(text)


@cache
def help_of(command: str) -> str:
    program = installed_programs() / "mr-damper"
    done = subprocess.run([program, command, "--help"], capture_output=True, text=True, check=True)
    return done.stdout


def check_command(command: str, arguments: list[str]) -> None:
    for word in arguments:
        if word.startswith("--"):
            assert word in help_of(command), f"{command} has no option {word}"
        check_path(word)


def check_launch(file: str, arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    loaded = launch_stand_in.load(ROOT / "launch" / file, monkeypatch)
    given = dict(argument.split(":=") for argument in arguments)
    described = loaded.generate_launch_description()
    names = {item.name for item in described if isinstance(item, launch_stand_in.Argument)}
    assert set(given) <= names
    check_path(given.get("bag", ""))


@pytest.mark.parametrize(("page", "line"), ALL, ids=lambda part: str(part)[-40:])
def test_what_a_command_names_exists(
    page: Path, line: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, *rest = shlex.split(re.sub(r"^(\w+=\S+ )+", "", line.replace(SHARE, "")))
    if first == "make":
        targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE)
        assert rest[0] in targets
    elif first == "mr-damper":
        check_command(rest[0], rest[1:])
    elif first != "ros2":
        assert first in OTHERS or "=" in first, f"{page.name}: {line}"
    elif rest[:2] == ["run", "mr_damper_ros"]:
        if rest[2] == "mr-damper":
            check_command(rest[3], rest[4:])
        else:
            check_node(rest[2], rest[3:])
    elif rest[:2] == ["launch", "mr_damper_ros"]:
        check_launch(rest[2], rest[3:], monkeypatch)
    elif rest[:2] == ["bag", "play"]:
        assert "--delay" in rest, "publishers and subscribers find each other only after the start"
        for word in rest:
            check_path(word)
    else:
        assert rest[0] in ("bag", "security", "lifecycle", "param", "service", "action", "topic")


def test_all_pages_with_commands_are_read() -> None:
    assert len(ALL) > 25
    assert {page.name for page, _ in ALL} >= {"README.md", "security.md", "live_rig.md", "time.md"}


def test_the_three_terminals_of_the_readme_identify_a_bag(
    listener: Listener, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Runs the lines of the README unchanged, with a stand-in for `ros2` if needed."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"```bash\n(ros2 run mr_damper_ros identifier.*?)```", text, re.DOTALL)
    lines = block.replace("/tmp/damper", str(tmp_path)).splitlines()
    assert len(lines) == 3
    monkeypatch.chdir(tmp_path)
    forces = listener.listen(PredictedForce, "/damper/predicted_force")
    terminals = [Program(["bash", "-c", line]) for line in (*lines[:2], f"{lines[2]} -p rate:=2.0")]
    try:
        assert terminals[2].wait() == 0, terminals[2].errors
        listener.until(lambda: any(message.valid for message in forces), "a valid force")
        # Ctrl-C goes to the whole group of a terminal: the command `ros2` forwards no signal.
        for terminal in terminals[:2]:
            os.killpg(terminal.pid, signal.SIGINT)
        for terminal in terminals[:2]:
            terminal.wait()
    finally:
        for terminal in terminals:
            with suppress(ProcessLookupError):
                os.killpg(terminal.pid, signal.SIGKILL)
    assert "end of the bag" in terminals[2].errors
    assert "Traceback" not in "".join(terminal.errors for terminal in terminals)
    assert (tmp_path / "identifier.yaml").exists()
    for terminal in terminals:
        terminal.close()
