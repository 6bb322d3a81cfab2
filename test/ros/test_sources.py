"""Sources of samples in the bridge: a stream of rows, and a source of another package."""

import os
import socket
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mr_damper_msgs.msg import MtsSamples, SupplyCurrent
from support import Listener, installed_programs

from mr_damper_ros.nodes.messages import from_field
from mr_damper_ros.processes.programs import Program, node_arguments

COLUMNS = "time:us,displacement:mm,force:kN,current:mA"

ONE_FILE = '''
"""Two samples 1 ms apart, and nothing after them."""

import time
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.signals.blocks import RigBlock
from mr_damper_ros.rig.sources.source import Source
from mr_damper_ros.settings.option_table import ParameterTable, option


@dataclass(frozen=True)
class PairOptions(ParameterTable):
    gain: float = option(1.0, "Factor on the force.", read_only=False)

    def objection(self) -> str:
        return ""


class PairSource(Source):
    options = PairOptions
    prefix = "pair."

    def open(self) -> list[str]:
        return [f"two samples, times {self.settings.gain}"]

    def blocks(self, start_ns):
        force = self.settings.gain * np.array([1.0, 2.0])
        yield RigBlock(start_ns, 0, 1e-3, np.zeros(2), force, np.ones(2), np.full(2, np.nan))
        none = np.empty(0)
        while True:
            time.sleep(0.05)
            yield RigBlock(start_ns, 2, 1e-3, none, none, none, none)

    def close(self) -> None:
        pass
'''

ENTRY_POINTS = """[mr_damper_ros.sources]
pair = pair_source:PairSource
broken = pair_source:NoSuchSource
wrong = pair_source:PairOptions
"""


@pytest.fixture
def installed(tmp_path: Path) -> dict[str, str]:
    """The environment with another package, whose entry point is a source."""
    (tmp_path / "pair_source.py").write_text(ONE_FILE, encoding="utf-8")
    folder = tmp_path / "pair_source-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: pair-source\nVersion: 1.0\n", encoding="utf-8"
    )
    (folder / "entry_points.txt").write_text(ENTRY_POINTS, encoding="utf-8")
    return {"PYTHONPATH": os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])}


def test_a_source_of_another_package_comes_by_its_entry_point(
    installed: dict[str, str], listener: Listener
) -> None:
    samples = listener.listen(MtsSamples, "mts/samples")
    command = [str(installed_programs() / "bridge")]
    parameters = {"source": "pair", "pair__gain": 3.0, "wait_for_subscribers": 1}
    bridge = Program([*command, *node_arguments(parameters)], installed)
    bridge.wait_for_log("two samples, times 3.0")
    listener.until(lambda: sum(len(m.force) for m in samples) == 2, "two samples")
    assert np.concatenate([from_field(m.force) for m in samples]).tolist() == [3.0, 6.0]
    assert bridge.stop() == 0, bridge.log
    # Invalid entry points are reported and do not stop the bridge.
    assert "the source broken cannot be loaded" in bridge.errors
    assert "the source wrong is not a Source" in bridge.errors
    bridge.close()


def test_rows_of_a_stream_come_on_the_topics(start: Any, listener: Listener) -> None:
    samples = listener.listen(MtsSamples, "mts/samples")
    current = listener.listen(SupplyCurrent, "supply/current")
    start("bridge", source="stream", stream__address="simulated", stream__columns=COLUMNS)
    listener.until(lambda: current and sum(len(m.force) for m in samples) >= 1000, "samples")
    moved = np.concatenate([from_field(message.displacement) for message in samples])
    pulled = np.concatenate([from_field(message.force) for message in samples])
    # A sine of 5 mm; the force is a hyperbolic tangent of the velocity, 1 kN.
    cosine = np.arctanh(np.clip(pulled / 1000.0, -0.99, 0.99)) / 3.0
    right = np.abs(pulled) < 950.0
    np.testing.assert_allclose(np.hypot(moved / 0.005, cosine)[right], 1.0, atol=1e-3)
    assert samples[0].period == pytest.approx(1e-3, rel=1e-6)
    assert {message.current for message in current} == {1.5}
    found = listener.wait_for_finding("bridge: source", "")
    assert {item.key: item.value for item in found.values}["connections"] == "1"


def test_a_stream_that_was_cut_is_connected_again(start: Any, listener: Listener) -> None:
    samples = listener.listen(MtsSamples, "mts/samples")
    server, ended = socket.create_server(("127.0.0.1", 0)), threading.Event()

    def send() -> None:
        begin, sent = 0.0, 0
        for lasts in (1.0, 60.0):
            with server.accept()[0] as link, suppress(OSError):
                begin = begin or time.monotonic()
                until = time.monotonic() + lasts
                while time.monotonic() < until and not ended.wait(0.04):
                    present = round(500.0 * (time.monotonic() - begin))
                    rows = (f"{2000 * k},{k % 10},1.0,1500\n" for k in range(sent, present))
                    link.sendall("".join(rows).encode())
                    sent = present

    threading.Thread(target=send, daemon=True).start()
    address = f"tcp:127.0.0.1:{server.getsockname()[1]}"
    start("bridge", source="stream", stream__address=address, stream__columns=COLUMNS)
    listener.until(lambda: samples and samples[-1].seq >= 1000, "samples after the cut")
    found = listener.wait_for_finding("bridge: source", "")
    ended.set()
    assert {item.key: item.value for item in found.values}["connections"] == "2"
