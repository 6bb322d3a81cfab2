"""Parameter sets kept on disk: atomic to write, checked when read, never outside one folder."""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import tempfile
from pathlib import Path

from mr_damper_ros.damper.parameters import ParameterError, ParameterSet

_VERSION = 1

_HEADER = re.compile(r"# mr_damper_ros parameters, version (\d+), sha256 ([0-9a-f]{64})\n")

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}")

_SIZE_LIMIT = 1 << 20
"""No parameter file comes near this many bytes; a bigger one is not read at all."""


class StateError(ValueError):
    """State that cannot be kept or read; the message says what to change."""


class StateDirectory:
    """Named parameter sets in one folder, each a YAML file with a checksum in its first line.

    A set written by hand has no such line and is read all the same. ``path`` is created when the
    first set is saved; "" keeps nothing, and every call says so.
    """

    def __init__(self, path: str | Path) -> None:
        self._path = Path(path).expanduser().absolute() if str(path) else None

    def file(self, name: str) -> Path:
        """Where the set ``name`` is kept. Raises StateError for anything but a plain name."""
        if self._path is None:
            raise StateError("nothing is kept on disk: set the parameter state_dir to a folder")
        name = name.removesuffix(".yaml")
        if not _NAME.fullmatch(name):
            raise StateError(
                f"the name {name[:100]!r} cannot be used: give one of letters, digits and _ . - "
                "(it names a file inside state_dir)"
            )
        return self._path / f"{name}.yaml"

    def save(self, name: str, parameters: ParameterSet) -> Path:
        """Keep a set under a name, in place of what was there, and return its file.

        Whatever happens meanwhile, the file holds either the old set or the new one. Raises
        StateError where the name or the folder cannot be used.
        """
        path = self.file(name)
        body = parameters.to_yaml()
        text = f"# mr_damper_ros parameters, version {_VERSION}, sha256 {_digest(body)}\n{body}"
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            _write_atomically(path, text)
        except OSError as error:
            raise StateError(
                f"cannot write {path}: {error.strerror}; "
                "set state_dir to a folder that can be written"
            ) from error
        return path

    def load(self, name: str) -> ParameterSet:
        """The set kept under a name.

        Raises StateError where there is none, or where its file is damaged or cannot be used.
        """
        path = self.file(name)
        if path.is_symlink() and path.resolve().parent != path.parent.resolve():
            raise StateError(f"{path} is a link out of state_dir: copy the file there instead")
        if not os.path.lexists(path):
            raise StateError(
                f"there is no {path}: the names kept are {', '.join(self.names()) or '(none)'}"
            )
        return read_parameter_file(path)

    def names(self) -> list[str]:
        """Names under which sets are kept, sorted."""
        if self._path is None or not self._path.is_dir():
            return []
        return sorted(path.stem for path in self._path.glob("*.yaml"))

    def set_aside(self, name: str) -> Path:
        """Rename a damaged file so that it is neither read again nor overwritten."""
        path = self.file(name)
        number = 0
        while (aside := path.with_suffix(f".damaged{number or ''}")).exists():
            number += 1
        try:
            path.rename(aside)
        except OSError as error:
            raise StateError(f"cannot rename {path}: {error.strerror}") from error
        return aside


def read_parameter_file(path: str | Path) -> ParameterSet:
    """The parameter set in a file, written by a :class:`StateDirectory` or by hand.

    Raises StateError where the file cannot be read, is damaged or does not fit.
    """
    path = Path(path).expanduser()
    try:
        if path.stat().st_size > _SIZE_LIMIT:
            raise StateError(f"{path} is too big for a parameter file: give another one")
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise StateError(f"{path} is damaged: it is not text") from error
    except (OSError, RuntimeError) as error:  # RuntimeError: a link to itself
        detail = getattr(error, "strerror", None) or "it is a link to itself"
        raise StateError(f"cannot read {path}: {detail}") from error
    try:
        return ParameterSet.from_yaml(_checked(text, path))
    except ParameterError as error:
        raise StateError(f"{path}: {error}") from error


def _digest(body: str) -> str:
    return hashlib.sha256(body.encode()).hexdigest()


def _checked(text: str, path: Path) -> str:
    """Body of a file, after a look at the checksum in its first line."""
    first_line = text.partition("\n")[0]
    if "mr_damper_ros parameters" not in first_line and "sha256" not in first_line:
        return text  # written by hand
    header = _HEADER.match(text)
    if header is None:
        raise StateError(f"{path} is damaged: its first line is not complete")
    if int(header[1]) > _VERSION:
        raise StateError(f"{path} was written by a newer version: update mr_damper_ros")
    body = text[header.end() :]
    if _digest(body) != header[2]:
        raise StateError(
            f"{path} is damaged: it is not what was written "
            "(if it was edited on purpose, delete its first line)"
        )
    return body


def _write_atomically(path: Path, text: str) -> None:
    descriptor, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(temporary)
        raise
    # The new name must survive a power failure too.
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
