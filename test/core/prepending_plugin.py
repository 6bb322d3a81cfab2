"""Imports test files as the pytest plug-in of launch_testing does: pytest -p prepending_plugin.

Where ROS is sourced, that plug-in is loaded without being asked for. It looks into each file for
a launch test, by pytest's default way of importing: by the bare name, from the file's own folder.
"""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

import pytest
from _pytest.pathlib import import_path

# pytest 8.1 wants to be told; the one of Ubuntu 24.04 does not know it.
_OPTIONS: dict[str, Any] = {}
if "consider_namespace_packages" in inspect.signature(import_path).parameters:
    _OPTIONS["consider_namespace_packages"] = False


def pytest_pycollect_makemodule(module_path: Path, parent: pytest.Collector) -> pytest.Module:
    """Import the file in that way, and go on as pytest does."""
    import_path(module_path, root=Path(), **_OPTIONS)
    return pytest.Module.from_parent(parent, path=module_path)
