"""Short variants of ``make soak``: kills, starts, Ctrl-C, some minutes of data at 20x speed."""

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


def test_a_stream_at_speed_leaves_no_errors_and_no_leak() -> None:
    hours_per_second = load.RATE / 3600.0
    growth, errors = load.soak(80.0 * hours_per_second, 20.0 * hours_per_second)
    assert errors == []
    assert sorted(growth) == ["bridge", "identifier", "model", "worker"]
    # Allowed memory growth [MB] of a node in the last minute. A leak of the blocks would add 17.
    # However busy the computer is, at most 5000 messages of 1.8 kB wait for a node: 9 MB.
    assert max(growth.values()) < 12.0, growth
