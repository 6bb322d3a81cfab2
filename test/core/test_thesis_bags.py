"""The program that makes the thesis' runs, and the bags that come with the package."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bag_contents import messages

from mr_damper_ros.io.bag_reader import read_bag
from mr_damper_ros.io.bag_writer import write_bag
from mr_damper_ros.models.published import find
from studies.thesis import bags as thesis_bags
from studies.thesis.published_runs import synthesise

COMMITTED = Path(__file__).resolve().parents[2] / "bags"
NAMES = ["5.0mm_1Hz_0.0A", "5.0mm_1Hz_0.5A", "5.0mm_1Hz_1.5A", "7.5mm_1Hz_1.0A"]

ROUNDING_FORCE, ROUNDING_DISPLACEMENT = 1e-9, 1e-15
"""[N] and [m]: processors differ in the last digit of a sine or a hyperbolic tangent."""


def folders(path: Path) -> list[str]:
    return sorted(entry.name for entry in path.iterdir() if entry.is_dir())


@pytest.mark.parametrize("name", NAMES)
def test_a_committed_bag_is_what_the_program_makes(name: str, tmp_path: Path) -> None:
    fresh = synthesise(find(name))
    write_bag(tmp_path / name, fresh)
    (committed,) = read_bag(COMMITTED / name)
    assert committed.name == fresh.name
    assert committed.start_ns == fresh.start_ns
    assert committed.period == fresh.period
    assert committed.details == fresh.details
    np.testing.assert_array_equal(committed.current, fresh.current)
    np.testing.assert_allclose(committed.force, fresh.force, rtol=0.0, atol=ROUNDING_FORCE)
    np.testing.assert_allclose(
        committed.displacement, fresh.displacement, rtol=0.0, atol=ROUNDING_DISPLACEMENT
    )
    a, b = (
        [(m.topic, m.message_type, m.time_ns, len(m.data)) for m in messages(folder)]
        for folder in (COMMITTED / name, tmp_path / name)
    )
    assert a == b


def test_an_erratum_is_marked_in_name_and_metadata(tmp_path: Path) -> None:
    assert thesis_bags.main([str(tmp_path), "--conditions", "7.5mm_3Hz_1.5A", "--errata"]) == 0
    assert folders(tmp_path) == ["7.5mm_3Hz_1.5A_erratum"]
    (marked,) = read_bag(tmp_path / "7.5mm_3Hz_1.5A_erratum")
    assert "k4 is +0.1405" in marked.details["erratum"]
