"""Process settings for all tests."""

import signal

import pytest

from mr_damper_ros.processes.blas_threads import keep_one_thread

# Several processes compute at once.
keep_one_thread()

# A shell starts background processes with Ctrl-C ignored, and the programs under test would inherit
# this.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests over DDS first, because they mostly wait; of these, the soak takes longest."""
    items.sort(key=lambda item: ("test/ros/" not in item.nodeid, "test_soak" not in item.nodeid))
