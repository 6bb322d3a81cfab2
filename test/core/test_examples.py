"""The examples run, on the data that ships with the package."""

import os
import sys
from pathlib import Path

import pytest
from fresh_python import said

TOP = Path(__file__).parents[2]
EXAMPLES = sorted((TOP / "examples").glob("*.py"))


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_runs(example: Path, tmp_path: Path) -> None:
    for folder in ("bags", "doc"):
        (tmp_path / folder).symlink_to(TOP / folder)
    environment = {**os.environ, "MPLBACKEND": "agg", "PYTHONPATH": str(TOP)}
    assert said(sys.executable, example, cwd=tmp_path, env=environment)
