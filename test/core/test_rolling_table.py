"""Tables of limited size: dropped rows, thinning, and the data for readers."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mr_damper_ros.live.live_record import RollingTable, first_of_two


def filled(rows: int, capacity: int = 8, *, thins: bool = False) -> RollingTable:
    table = RollingTable(("value",), capacity, first_of_two if thins else None)
    for number in range(rows):
        table.extend([(10.0 * number,)])
    return table


def test_a_full_table_loses_its_oldest_rows() -> None:
    assert filled(9).after(-1)[:, 0].tolist() == [2, 3, 4, 5, 6, 7, 8]


def test_one_that_thins_keeps_the_whole_time_in_view() -> None:
    assert filled(9, thins=True).after(-1)[:, 0].tolist() == [0, 2, 4, 5, 6, 7, 8]


def test_rows_that_are_given_out_do_not_change_later() -> None:
    table = filled(8)
    given_out = table.after(-1)
    for _ in range(8):
        table.extend([(-1.0,)])
    assert given_out[:, 1].tolist() == [10.0 * n for n in range(8)]


@given(rows=st.integers(0, 200), capacity=st.integers(8, 40), thins=st.booleans())
def test_numbers_rise_the_newest_is_there_and_the_memory_bounded(
    rows: int, capacity: int, thins: bool
) -> None:
    table = filled(rows, capacity, thins=thins)
    numbers = table.after(-1)[:, 0]
    assert numbers.size <= capacity
    assert np.all(np.diff(numbers) > 0)
    assert rows == 0 or numbers[-1] == rows - 1
    if thins and rows:
        assert numbers[0] == 0
