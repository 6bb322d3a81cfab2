"""What the nodes load: not SciPy, which takes longer than all the rest."""

from __future__ import annotations

import subprocess
import sys

import pytest


@pytest.mark.parametrize(
    "modules",
    [
        "mr_damper_ros.tracking.predictor",
        "mr_damper_ros.tracking.tracker, mr_damper_ros.tracking.tracker_memory",
        "mr_damper_ros.tracking.pipeline, mr_damper_ros.processes.worker",
        "mr_damper_ros.io.bags, mr_damper_ros.io.records, mr_damper_ros.rig.emulator",
    ],
)
def test_a_node_starts_without_scipy(modules: str) -> None:
    code = f"import sys, {modules}; sys.exit('scipy' in sys.modules)"
    # With all paths of this process, but without what it has loaded.
    path = f"import sys; sys.path[:] = {sys.path!r}; "
    assert subprocess.run([sys.executable, "-c", path + code], check=False).returncode == 0
