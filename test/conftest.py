"""What all tests need of the process that they run in."""

from __future__ import annotations

import signal

import pytest

from mr_damper_ros.processes.blas_threads import keep_one_thread

# Several processes compute at once.
keep_one_thread()

# A shell starts what runs in its background with Ctrl-C ignored, and so would be all programs that
# the tests start: those that are to end by it would not.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests over DDS first, since they mostly wait; of these, the soak takes the longest."""
    items.sort(key=lambda item: ("test/ros/" not in item.nodeid, "test_soak" not in item.nodeid))
