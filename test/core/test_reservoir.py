"""The newest window of each operating point is kept, and not too many."""

import known
import numpy as np
import pytest
from random_motion import BandLimitedRandom

from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.tracking.operating_point import KnownPoints, thinned_to_keep


def keep(points: KnownPoints, window: Window, number: int) -> KnownPoints:
    return points.with_window(window, window.operating_point, number)


def test_the_newest_window_of_each_operating_point_is_kept() -> None:
    points, number = KnownPoints(), 0
    for seed in (1, 2):
        for current in (0.5, 1.0):
            window = known.run(current=current, seed=seed, samples=500).window
            points = keep(points, window, number)
            number += 1
    assert len(points.windows) == 2
    newest = known.run(current=0.5, seed=2, samples=500).force
    np.testing.assert_array_equal(points.windows[0].force, newest)


def test_of_a_law_without_memory_only_the_samples_are_kept() -> None:
    motion = BandLimitedRandom(3e-3, 0.5, 3.0).at(np.arange(2000) * known.PERIOD)
    window = Window.from_samples(motion.displacement, motion.velocity, 1.0, known.PERIOD)
    kept = thinned_to_keep(window, with_past=True)
    bare = thinned_to_keep(window, with_past=False)
    assert kept.whole is not None
    assert bare.whole is None
    np.testing.assert_array_equal(bare.motion.velocity, kept.motion.velocity)
    np.testing.assert_array_equal(bare.force, kept.force)


def test_the_oldest_window_and_record_go_when_too_many_are_kept() -> None:
    points = KnownPoints()
    window = known.run(samples=200).window
    for number in range(303):
        current = 0.1 * number
        shifted = Window(window.motion, window.force, np.full(200, current))
        after = keep(points, shifted, number).noted((1e-3, current), force=None)
        points = points.updated(after)
    currents = [float(w.current[0]) for w in points.windows]
    assert currents == pytest.approx([0.1 * number for number in range(203, 303)])
    others = [each.point[1] for each in points.records if not each.number]
    assert others == pytest.approx([0.1 * number for number in range(203, 303)])
