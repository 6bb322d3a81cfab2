"""Parameter sets on disk, in one folder: written atomically and checked when read."""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import stat
from pathlib import Path

from mr_damper_ros.models.parameter_set import ParameterError, ParameterSet, UserError, check_set
from mr_damper_ros.models.plausibility import check_plausible
from mr_damper_ros.processes.files import FolderLock, LockHeldError, write_text

_FORMAT = 3
"""Version of the format of the files; no other is read."""

_HEADER = re.compile(r"# mr_damper_ros parameters, version ([1-9]\d{0,8}), sha256 ([0-9a-f]{64})\n")

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}")

_MEMORY_LINE = "\n# memory "
"""Start of the last line, which is a comment in YAML."""

_FILE_LIMIT = 1 << 26
"""Largest size in bytes of a file; real files are far smaller, even with the tracker's memory."""

_ASIDE, _READ = "aside", "aside-read"
"""Suffixes of files that could not be used, before and after a user has acknowledged them."""


class StateError(UserError):
    """State that cannot be stored or read; the message says what to change."""


class StateDirectory:
    """Named parameter sets in one folder, each a YAML file with a checksum in its first line.

    A set written by hand has no such line and is accepted. A file may also contain the memory of
    the tracker that identified the set: one line of text, see
    :mod:`mr_damper_ros.tracking.tracker_state`. ``path`` is created when the first set is saved.
    With the path "" nothing is stored, and calls that need a file raise StateError.
    """

    def __init__(self, path: str | Path) -> None:
        try:
            self._path = Path(path).expanduser().absolute() if str(path) else None
        except RuntimeError as error:
            raise StateError(f"{path} cannot be used as state_dir: {error}") from error

    @property
    def keeps(self) -> bool:
        """Whether there is a folder to store sets in."""
        return self._path is not None

    def file(self, name: str) -> Path:
        """Path of the file of the set ``name``. Raises StateError if this is not a plain name."""
        if self._path is None:
            raise StateError("nothing is stored on disk: set the parameter state_dir to a folder")
        name = name.removesuffix(".yaml")
        if not _NAME.fullmatch(name):
            raise StateError(
                f"the name {name[:100]!r} cannot be used: give one of letters, digits and _ . - "
                "(it becomes the name of a file in state_dir)"
            )
        return self._path / f"{name}.yaml"

    def save(self, name: str, parameters: ParameterSet, memory: str = "") -> Path:
        """Store a set under a name, replacing an older one, and return its file.

        At any time the file contains either the whole old or the whole new set. Raises StateError
        if the name or the folder cannot be used, or if the set is implausible.
        """
        path = self.file(name)
        try:
            check_plausible(parameters)
        except ParameterError as error:
            raise StateError(f"{parameters.set_id} is not stored: {error}") from error
        body = parameters.to_yaml()
        if memory:
            body = f"{body.rstrip()}{_MEMORY_LINE}{memory}\n"
        text = f"# mr_damper_ros parameters, version {_FORMAT}, sha256 {_digest(body)}\n{body}"
        try:
            write_text(path, text, durable=True)
        except OSError as error:
            raise _unwritable(path, error) from error
        return path

    def load(self, name: str) -> tuple[ParameterSet, str]:
        """The set stored under a name, and its memory.

        The memory is empty if none was stored, or if the set was edited and the memory no longer
        matches. Raises StateError if there is no set, or if its file is damaged or cannot be used.
        """
        path = self.file(name)
        if path.is_symlink() and os.path.dirname(os.path.realpath(path)) != os.path.realpath(
            path.parent
        ):
            raise StateError(f"{path} is a link out of state_dir: replace it by a copy of the file")
        if not os.path.lexists(path):
            raise StateError(
                f"there is no {path}: the stored names are {', '.join(self.names()) or '(none)'}"
            )
        parameters, memory = _read(path)
        try:
            return check_plausible(parameters), memory
        except ParameterError as error:
            raise StateError(f"{path}: {error}") from error

    def names(self) -> list[str]:
        """Names of the stored sets, sorted."""
        return sorted(path.stem for path in self._path.glob("*.yaml")) if self._path else []


# The own file of a tracker


def lock_file(path: Path) -> FolderLock:
    """Reserve a file for this process until the lock is released.

    Raises StateError if another process holds it, or if the folder cannot be written.
    """
    try:
        return FolderLock(_lock_of(path))
    except LockHeldError as error:
        raise StateError(
            f"{path} is in use by another node"
            + (f" (process {error.holder})" if error.holder else "")
            + ": give this node another name, namespace or state_dir"
        ) from error
    except OSError as error:
        raise _unwritable(path, error) from error


def is_of_a_node(path: Path) -> bool:
    """Whether a node stores, or has stored, its own state in a file."""
    if os.path.lexists(_lock_of(path)):
        return True
    try:
        return _read(path)[1] != ""
    except StateError:
        return False


def set_aside(path: Path) -> Path:
    """Rename an unusable file, so that it is neither read again nor overwritten."""
    return _renamed(path, path.with_suffix(f".{_ASIDE}"))


def unread_asides(path: Path) -> list[Path]:
    """Files of this name that were set aside and have not been acknowledged."""
    pattern = re.compile(rf"{re.escape(path.stem)}\.{_ASIDE}\d*")
    return sorted(each for each in path.parent.glob("*") if pattern.fullmatch(each.name))


def mark_asides_read(path: Path) -> None:
    """Rename the files set aside, so that they are no longer reported.

    Raises StateError if the folder cannot be written.
    """
    for aside in unread_asides(path):
        _renamed(aside, path.with_suffix(f".{_READ}"))


def remove_unfinished(path: Path) -> None:
    """Remove temporary files of a process that was killed while it saved a set."""
    for unfinished in path.parent.glob(f".{path.name}.*"):
        with contextlib.suppress(OSError):
            unfinished.unlink()


SetSource = ParameterSet | str | os.PathLike[str]
"""A parameter set, or the path of its file."""


def given_set(source: SetSource) -> ParameterSet:
    """The set, or the set in the file. Raises StateError, and ParameterError for another type."""
    if isinstance(source, (str, os.PathLike)):
        return read_parameter_file(Path(source))
    check_set(source)
    return source


def read_parameter_file(path: str | Path) -> ParameterSet:
    """The parameter set in a file, written by a :class:`StateDirectory` or by hand.

    Raises StateError if the file cannot be read, is damaged or is not a parameter file.
    """
    return _read(Path(path))[0]


def _read(path: Path) -> tuple[ParameterSet, str]:
    """The set in a file, and its memory."""
    text = _text(path)
    body = _checked(text, path)
    own_set, _, memory = body.partition(_MEMORY_LINE)
    if len(own_set) > _FILE_LIMIT >> 10:
        raise StateError(f"{path} is too large for a parameter file: give another file")
    try:
        parameters = ParameterSet.from_yaml(own_set)
    except ParameterError as error:
        raise StateError(f"{path}: {error}") from error
    return parameters, memory.rstrip("\n") if body is not text else ""


def _text(path: Path) -> str:
    """The text of a file, with line ends converted to newlines."""
    try:
        path = path.expanduser()
        status = path.stat()
        regular, small = stat.S_ISREG(status.st_mode), status.st_size <= _FILE_LIMIT
        text = path.read_text(encoding="utf-8") if regular and small else ""
    except UnicodeDecodeError as error:
        raise StateError(f"{path} is damaged: it is not text") from error
    except OSError as error:
        raise StateError(f"cannot read {path}: {error.strerror}") from error
    except (RuntimeError, ValueError) as error:  # a link to itself, an unknown user, a null byte
        raise StateError(f"cannot read {str(path)!r}: it is not a valid path") from error
    if not regular:
        raise StateError(f"cannot read {path}: it is not a file")
    if not small:
        raise StateError(f"{path} is too large for a parameter file: give another file")
    return text


def _unwritable(path: Path, error: OSError) -> StateError:
    return StateError(
        f"cannot write {path}: {error.strerror}; set state_dir to a folder that can be written"
    )


def _digest(body: str) -> str:
    return hashlib.sha256(body.encode()).hexdigest()


def _checked(text: str, path: Path) -> str:
    """Body of a file whose checksum is right; the whole text if it has no checksum."""
    first_line = text.partition("\n")[0]
    if "mr_damper_ros parameters" not in first_line and "sha256" not in first_line:
        return text  # written by hand
    header = _HEADER.match(text)
    if header is None:
        raise StateError(f"{path} is damaged: its first line is not complete")
    if int(header[1]) != _FORMAT:
        raise StateError(
            f"{path} has version {header[1]} of the format, but this mr_damper_ros reads only "
            f"version {_FORMAT}: delete the first line of the file to use its parameter set alone"
        )
    body = text[header.end() :]
    if _digest(body) != header[2]:
        raise StateError(
            f"{path} is damaged: its checksum is wrong (if it was edited on purpose, delete its "
            "first line)"
        )
    return body


def _lock_of(path: Path) -> Path:
    return path.with_name(f".{path.stem}.lock")


def _renamed(path: Path, wanted: Path) -> Path:
    """Rename a file, with a number at the end of the new name if that is already in use."""
    free, number = wanted, 0
    while os.path.lexists(free):
        number += 1
        free = wanted.with_name(f"{wanted.name}{number}")
    try:
        return path.rename(free)
    except OSError as error:
        raise StateError(f"cannot rename {path}: {error.strerror}") from error
