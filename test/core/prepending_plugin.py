"""Imports test files as the pytest plug-in of launch_testing does: pytest -p prepending_plugin.

Where ROS is sourced, that plug-in is loaded without being asked for. It looks into each file for
a launch test, by pytest's default way of importing: by the bare name, from the file's own folder.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from _pytest.pathlib import import_path


def pytest_pycollect_makemodule(module_path: Path, parent: pytest.Collector) -> pytest.Module:
    """Import the file in that way, and go on as pytest does."""
    import_path(module_path, root=Path(), consider_namespace_packages=False)
    return pytest.Module.from_parent(parent, path=module_path)
