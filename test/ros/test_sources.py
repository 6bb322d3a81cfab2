"""A source of one's own: one file, one line in the registry, and the bridge streams it."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from mr_damper_msgs.msg import MtsSamples, SupplyCurrent
from support import Listener, installed_programs

from mr_damper_ros.nodes.messages import from_field, to_nanoseconds
from mr_damper_ros.processes.programs import Program, node_arguments

ONE_FILE = '''
"""Lines of displacement [m], force [N] and current [A] from a named pipe, 1 ms apart."""

import os
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.signals.blocks import RigBlock
from mr_damper_ros.rig.sources.source import Source
from mr_damper_ros.settings.option_table import ParameterTable, option


@dataclass(frozen=True)
class PipeOptions(ParameterTable):
    path: str = option("", "Path of the pipe.")
    gain: float = option(1.0, "Factor on the force.", read_only=False)

    def objection(self) -> str:
        return "" if self.path else "source is pipe, but pipe.path is empty: name a pipe"


class PipeSource(Source):
    options = PipeOptions
    prefix = "pipe."

    def open(self) -> list[str]:
        self._pipe = os.open(self.settings.path, os.O_RDONLY | os.O_NONBLOCK)
        self._rest = b""
        return [f"reading {self.settings.path}"]

    def blocks(self, start_ns: int) -> Iterator[RigBlock]:
        sequence = 0
        while True:
            rows = self._rows()
            if rows.size == 0:
                time.sleep(0.05)
            yield RigBlock(
                start_ns=start_ns + sequence * 1_000_000,
                sequence=sequence,
                period=1e-3,
                displacement=rows[:, 0],
                force=rows[:, 1] * self.settings.gain,
                current=rows[:, 2],
                temperature=np.full(len(rows), np.nan),
            )
            sequence += len(rows)

    def _rows(self):
        try:
            data = self._rest + os.read(self._pipe, 65536)
        except BlockingIOError:
            data = self._rest
        lines, _, self._rest = data.rpartition(b"\\n")
        return np.array([line.split() for line in lines.splitlines()], dtype=float).reshape(-1, 3)

    def close(self) -> None:
        os.close(self._pipe)
'''

ONE_LINE = 'SOURCES["pipe"] = PipeSource'

PROGRAM = """
import sys
from mr_damper_ros.rig.sources import SOURCES
from pipe_source import PipeSource
{line}
from mr_damper_ros.entry_points import bridge
sys.exit(bridge())
"""


@pytest.fixture
def program(tmp_path: Path) -> Path:
    (tmp_path / "pipe_source.py").write_text(ONE_FILE, encoding="utf-8")
    path = tmp_path / "bridge_with_pipe.py"
    path.write_text(PROGRAM.format(line=ONE_LINE), encoding="utf-8")
    return path


def started(program: Path, **parameters: object) -> Program:
    return Program([sys.executable, str(program), *node_arguments(parameters)])


@pytest.fixture
def pipe(tmp_path: Path) -> Iterator[tuple[Path, int]]:
    path = tmp_path / "pipe"
    os.mkfifo(path)
    descriptor = os.open(path, os.O_RDWR)
    yield path, descriptor
    os.close(descriptor)


def test_it_streams_what_comes_as_it_comes(
    program: Path, pipe: tuple[Path, int], listener: Listener
) -> None:
    samples = listener.listen(MtsSamples, "mts/samples")
    current = listener.listen(SupplyCurrent, "supply/current")
    path, descriptor = pipe
    bridge = started(program, source="pipe", pipe__path=path, wait_for_subscribers=1)
    bridge.wait_for_log(f"reading {path}")
    listener.wait_for_publishers("mts/samples")
    listener.until(
        lambda: listener.node.get_publishers_info_by_topic("/supply/current"), "the topics"
    )
    listener.spin_for(1.0)  # nothing has come: nothing is sent, and nothing has failed
    assert samples == []
    rows = np.array([[1e-3 * k, 10.0 * k, 0.5] for k in range(200)])
    for part in np.split(rows, 4):
        os.write(descriptor, b"".join(b"%r %r %r\n" % tuple(row) for row in part.tolist()))
    listener.until(lambda: sum(len(m.force) for m in samples) == 200, "all samples")
    force = np.concatenate([from_field(message.force) for message in samples])
    assert (force == rows[:, 1]).all()
    assert [message.seq for message in samples] == list(
        np.cumsum([0, *(len(m.force) for m in samples)])[:-1]
    )
    listener.until(lambda: current, "the current, which is on a topic of its own")
    assert {message.current for message in current} == {0.5}
    assert to_nanoseconds(current[0].header.stamp) == to_nanoseconds(samples[0].header.stamp)

    assert listener.set_parameter("bridge", "pipe.gain", 2.0).successful
    samples.clear()
    os.write(descriptor, b"0 1 0.5\n0 2 0.5\n")
    listener.until(lambda: sum(len(m.force) for m in samples) == 2, "two more")
    assert np.concatenate([from_field(m.force) for m in samples]).tolist() == [2.0, 4.0]
    assert bridge.stop() == 0, bridge.log
    bridge.close()


ENTRY_POINTS = """[mr_damper_ros.sources]
pipe = pipe_source:PipeSource
broken = pipe_source:NoSuchSource
wrong = pipe_source:PipeOptions
"""


@pytest.fixture
def installed(tmp_path: Path) -> dict[str, str]:
    """The environment in which another package is installed, with a source as its entry point."""
    (tmp_path / "pipe_source.py").write_text(ONE_FILE, encoding="utf-8")
    folder = tmp_path / "pipe_source-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: pipe-source\nVersion: 1.0\n", encoding="utf-8"
    )
    (folder / "entry_points.txt").write_text(ENTRY_POINTS, encoding="utf-8")
    return {"PYTHONPATH": os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])}


def test_a_source_of_another_package_comes_by_its_entry_point(
    installed: dict[str, str], pipe: tuple[Path, int], listener: Listener
) -> None:
    samples = listener.listen(MtsSamples, "mts/samples")
    path, descriptor = pipe
    command = [str(installed_programs() / "bridge")]
    parameters = {"source": "pipe", "pipe__path": path, "wait_for_subscribers": 1}
    bridge = Program([*command, *node_arguments(parameters)], installed)
    bridge.wait_for_log(f"reading {path}")
    os.write(descriptor, b"0 1 0.5\n0 2 0.5\n")
    listener.until(lambda: sum(len(m.force) for m in samples) == 2, "two samples")
    assert np.concatenate([from_field(m.force) for m in samples]).tolist() == [1.0, 2.0]
    assert bridge.stop() == 0, bridge.log
    # Those that are none are told, and hold up nothing.
    assert "the source broken cannot be loaded" in bridge.errors
    assert "the source wrong is no Source" in bridge.errors
    bridge.close()
