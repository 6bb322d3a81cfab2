"""Short variants of ``make soak``: kills, starts, Ctrl-C, some seconds of data at 20x speed."""

import pytest

pytest.importorskip("rclpy", reason="these tests need ROS")

from benchmarks import hostile_starts, kills, load


def test_whatever_is_killed_the_state_stays() -> None:
    carried_out = kills.kill_all(nodes=3, workers=1, seed=2)
    assert sorted(kill.victim for kill in carried_out) == [
        *("bridge", "identifier", "model", "worker")
    ]
    assert [kill.fault for kill in carried_out if kill.fault] == []


def test_no_start_fails_because_of_its_files() -> None:
    assert hostile_starts.campaign(100, seed=1) == []


def test_no_node_fails_to_start_because_of_its_files() -> None:
    assert hostile_starts.campaign_of_nodes(3, seed=1) == []


def test_a_node_ends_cleanly_whenever_it_is_interrupted() -> None:
    pressed = kills.interrupt_all(count=2, seed=3)
    assert {one.node for one in pressed} == set(kills.INTERRUPTED)
    assert {one.signals for one in pressed} == {1, 2}
    assert any(one.age < kills.START for one in pressed)
    assert [one for one in pressed if one.fault] == []


def test_a_stream_at_speed_leaves_no_errors() -> None:
    # A leak would need minutes to exceed the messages that may wait for a node: make soak.
    hours_per_second = load.RATE / 3600.0
    growth, errors = load.soak(20.0 * hours_per_second, 10.0 * hours_per_second)
    assert errors == []
    assert sorted(growth) == ["bridge", "identifier", "model", "worker"]
