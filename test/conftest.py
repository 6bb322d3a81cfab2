"""How the tests are shared out where pytest-xdist runs them in several processes."""

from __future__ import annotations

from pathlib import Path

import pytest

ROS = Path(__file__).parent / "ros"


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Keep a file in one process, for its fixtures, and all nodes too: they need the time."""
    for item in items:
        group = "nodes" if ROS in item.path.parents else item.path.name
        item.add_marker(pytest.mark.xdist_group(group))
