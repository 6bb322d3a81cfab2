"""A source of one's own: one file, one line in the registry, and the bridge streams it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from mr_damper_msgs.msg import MtsSamples
from support import Listener, installed_programs

from mr_damper_ros.nodes.messages import from_field
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


@pytest.fixture
def pipe(tmp_path: Path) -> Iterator[tuple[Path, int]]:
    path = tmp_path / "pipe"
    os.mkfifo(path)
    descriptor = os.open(path, os.O_RDWR)
    yield path, descriptor
    os.close(descriptor)


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
