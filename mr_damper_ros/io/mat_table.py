"""Columns from a MAT file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mr_damper_ros.io.columns import Column, Columns
from mr_damper_ros.io.mat import MatError, Matrices, read_matrices
from mr_damper_ros.io.raw_table import RawTable, RecordError, too_long
from mr_damper_ros.signals.arrays import Array


def read_mat_table(
    path: Path, columns: Columns, variable: str | None, maximum_samples: int
) -> RawTable:
    """Read columns of one matrix, ``variable`` where there are several, or a variable for each.

    Raises RecordError.
    """
    if any(column.holds_dates for column in columns.wanted):
        raise RecordError("a MAT file holds numbers: give the unit of its time, such as time:s")
    try:
        variables = read_matrices(path, maximum_samples)
    except MatError as error:
        raise RecordError(f"{path.name} {error}") from error
    if columns.by_header:
        if variable is not None:
            raise RecordError(
                "the columns name variables of the MAT file themselves: choose no variable"
            )
        table = _vectors(path, variables, columns.wanted)
    else:
        matrix = _matrix(path, variables, columns, variable)
        fault = columns.fault_of_width(path.name, matrix.shape[1])
        if fault:
            raise RecordError(fault)
        table = RawTable(
            {c.quantity: matrix[:, c.position] for c in columns.wanted},
            lambda row: f"row {row + 1}",
        )
    if table.row_count > maximum_samples:
        raise too_long(path.name, maximum_samples)
    return table


def _listed(variables: Matrices) -> str:
    shapes = [f"{name} ({v.shape[0]} x {v.shape[1]})" for name, v in variables.items()]
    return ", ".join(shapes) or "no matrix of numbers"


def _matrix(path: Path, variables: Matrices, columns: Columns, variable: str | None) -> Array:
    # Samples may run down or across.
    upright = {n: v.T if v.shape[0] < v.shape[1] else v for n, v in variables.items()}
    needed = 1 + max(column.position for column in columns.wanted)
    if variable is None:
        fitting = [n for n, v in upright.items() if v.shape[1] >= needed and v.shape[0] > 1]
        if len(fitting) != 1:
            raise RecordError(
                f"{path.name} holds {len(fitting)} matrices with {needed} columns or more: "
                f"choose one as the variable; it holds {_listed(variables)}"
            )
        variable = fitting[0]
    if variable not in upright:
        raise RecordError(
            f"{path.name} has no variable '{variable}': it holds {_listed(variables)}"
        )
    matrix = np.asarray(upright[variable], dtype=np.float64)
    if matrix.shape[1] < needed:
        raise RecordError(
            f"the variable '{variable}' in {path.name} has {matrix.shape[1]} columns, but column "
            f"{needed} is wanted"
        )
    return matrix


def _vectors(path: Path, variables: Matrices, columns: Sequence[Column]) -> RawTable:
    values = {}
    for column in columns:
        vector = variables.get(column.header)
        if vector is None or min(vector.shape) != 1:
            raise RecordError(
                f"{path.name} has no variable '{column.header}' that is one row or column: "
                f"it holds {_listed(variables)}"
            )
        values[column.quantity] = np.asarray(vector, dtype=np.float64).ravel()
    lengths = {column.header: values[column.quantity].size for column in columns}
    if len(set(lengths.values())) > 1:
        raise RecordError(
            f"the variables in {path.name} differ in length: "
            + ", ".join(f"{name} has {length}" for name, length in lengths.items())
        )
    return RawTable(values, lambda row: f"row {row + 1}")
