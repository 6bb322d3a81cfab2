"""Parameter sets in files."""

from __future__ import annotations

from pathlib import Path

from mr_damper_ros.damper.parameters import ParameterError, ParameterSet


def read_parameters(path: str | Path) -> ParameterSet:
    """Parameter set of a YAML file; raises ParameterError with a sentence that names the file."""
    try:
        text = Path(path).read_text(encoding="utf-8")
    except OSError as error:
        raise ParameterError(f"{path} cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ParameterError(f"{path} is not a text file: give a YAML file") from error
    try:
        return ParameterSet.from_yaml(text)
    except ParameterError as error:
        raise ParameterError(f"{path}: {error}") from error
