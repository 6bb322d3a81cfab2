"""Parameter sets kept on disk: atomic to write, checked when read, never outside one folder."""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import stat
import tempfile
from pathlib import Path

from mr_damper_ros.models.parameter_set import ParameterError, ParameterSet, SpokenError
from mr_damper_ros.models.plausibility import check_plausible
from mr_damper_ros.processes.files import FolderLock, LockHeldError

_PLAIN, _WITH_MEMORY = 1, 2
"""Versions of the files: a set alone, and one with the memory of what identified it."""

_HEADER = re.compile(r"# mr_damper_ros parameters, version ([1-9]\d{0,8}), sha256 ([0-9a-f]{64})\n")

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}")

_MEMORY_LINE = "\n# memory "
"""Begin of the last line, which for YAML is a comment."""

_SET_LIMIT = 1 << 16
_FILE_LIMIT = 1 << 26
"""No parameter set, and no file with its memory, comes near so many bytes."""


_ASIDE, _READ = "aside", "aside-read"
"""Ends of the names of files that could not be used, before and after somebody took notice."""


class StateError(SpokenError):
    """State that cannot be kept or read; the message says what to change."""


class StateDirectory:
    """Named parameter sets in one folder, each a YAML file with a checksum in its first line.

    A set written by hand has no such line and is read all the same. With a set goes the memory of
    the tracker that identified it, if it is given: one line of text, see
    :mod:`mr_damper_ros.tracking.tracker_state`. ``path`` is created when the first set is saved;
    "" keeps nothing, and every call says so.
    """

    def __init__(self, path: str | Path) -> None:
        try:
            self._path = Path(path).expanduser().absolute() if str(path) else None
        except RuntimeError as error:
            raise StateError(f"{path} cannot be used as state_dir: {error}") from error

    @property
    def keeps(self) -> bool:
        """Whether there is a folder to keep anything in."""
        return self._path is not None

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

    def save(self, name: str, parameters: ParameterSet, memory: str = "") -> Path:
        """Keep a set under a name, in place of what was there, and return its file.

        Whatever happens meanwhile, the file holds either all of the old or all of the new. Raises
        StateError where the name or the folder cannot be used, or the set is not plausible.
        """
        path = self.file(name)
        try:
            check_plausible(parameters)
        except ParameterError as error:
            raise StateError(f"{parameters.set_id} is not kept: {error}") from error
        version, body = _PLAIN, parameters.to_yaml()
        if memory:
            version, body = _WITH_MEMORY, f"{body.rstrip()}{_MEMORY_LINE}{memory}\n"
        text = f"# mr_damper_ros parameters, version {version}, sha256 {_digest(body)}\n{body}"
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
        return self.load_with_memory(name)[0]

    def load_with_memory(self, name: str) -> tuple[ParameterSet, str]:
        """The set kept under a name, and its memory.

        That is empty where none was kept, or where the set was edited: then they are no longer one
        another's. Raises StateError as :meth:`load`.
        """
        path = self.file(name)
        if path.is_symlink() and os.path.dirname(os.path.realpath(path)) != os.path.realpath(
            path.parent
        ):
            raise StateError(f"{path} is a link out of state_dir: copy the file there instead")
        if not os.path.lexists(path):
            raise StateError(
                f"there is no {path}: the names kept are {', '.join(self.names()) or '(none)'}"
            )
        parameters, memory = _read(path)
        try:
            return check_plausible(parameters), memory
        except ParameterError as error:
            raise StateError(f"{path}: {error}") from error

    def lock(self, name: str) -> FolderLock:
        """Make the name that of this process, until the lock is released.

        Raises StateError where another process has it, or where the folder cannot be written.
        """
        path = self.file(name)
        try:
            return FolderLock(_lock_of(path))
        except LockHeldError as error:
            raise StateError(
                f"{path} is in use by another node"
                + (f" (process {error.holder})" if error.holder else "")
                + ": give this one another name, namespace or state_dir"
            ) from error
        except OSError as error:
            raise StateError(
                f"cannot write {path}: {error.strerror}; "
                "set state_dir to a folder that can be written"
            ) from error

    def is_of_a_node(self, name: str) -> bool:
        """Whether a name is that under which a node keeps, or has kept, its own state."""
        path = self.file(name)
        if os.path.lexists(_lock_of(path)):
            return True
        try:
            return _read(path)[1] != ""
        except StateError:
            return False

    def names(self) -> list[str]:
        """Names under which sets are kept, sorted."""
        if self._path is None or not self._path.is_dir():
            return []
        return sorted(path.stem for path in self._path.glob("*.yaml"))

    def set_aside(self, name: str) -> Path:
        """Rename a file that cannot be used, so that it is neither read again nor overwritten."""
        path = self.file(name)
        return _renamed(path, path.with_suffix(""), _ASIDE)

    def unread_asides(self, name: str) -> list[Path]:
        """Files of this name that were set aside, and that nobody has taken notice of."""
        path = self.file(name)
        pattern = re.compile(rf"{re.escape(path.stem)}\.{_ASIDE}\d*")
        if not path.parent.is_dir():
            return []
        return sorted(path.parent / n for n in os.listdir(path.parent) if pattern.fullmatch(n))

    def mark_asides_read(self, name: str) -> list[Path]:
        """Rename what was set aside, so that it is not spoken of any more; returns the new names.

        Raises StateError where the folder cannot be written.
        """
        without_ending = self.file(name).with_suffix("")
        return [_renamed(aside, without_ending, _READ) for aside in self.unread_asides(name)]

    def remove_unfinished(self, name: str) -> None:
        """Remove what a process left behind that was killed while it saved this set."""
        path = self.file(name)
        for unfinished in path.parent.glob(f"{_unfinished_prefix(path)}*"):
            with contextlib.suppress(OSError):
                unfinished.unlink()


def read_parameter_file(path: str | Path) -> ParameterSet:
    """The parameter set in a file, written by a :class:`StateDirectory` or by hand.

    Raises StateError where the file cannot be read, is damaged or does not fit.
    """
    return _read(Path(path))[0]


def _read(path: Path) -> tuple[ParameterSet, str]:
    """The set in a file, and the memory that goes with it."""
    text = _text(path)
    body = _checked(text, path)
    own_set, _, memory = body.partition(_MEMORY_LINE)
    if len(own_set) > _SET_LIMIT:
        raise StateError(f"{path} is too big for a parameter file: give another one")
    try:
        parameters = ParameterSet.from_yaml(own_set)
    except ParameterError as error:
        raise StateError(f"{path}: {error}") from error
    return parameters, memory.rstrip("\n") if body is not text else ""


def _text(path: Path) -> str:
    """What a file holds; lines that end as on other systems count as ours."""
    try:
        path = path.expanduser()
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise StateError(f"cannot read {path}: it is no file")
        if status.st_size > _FILE_LIMIT:
            raise StateError(f"{path} is too big for a parameter file: give another one")
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise StateError(f"{path} is damaged: it is not text") from error
    except OSError as error:
        raise StateError(f"cannot read {path}: {error.strerror}") from error
    except StateError:
        raise
    except (RuntimeError, ValueError) as error:  # a link to itself, an unknown user, a null byte
        raise StateError(f"cannot read {str(path)!r}: it is no usable path") from error


def _digest(body: str) -> str:
    return hashlib.sha256(body.encode()).hexdigest()


def _checked(text: str, path: Path) -> str:
    """Body of a file, after a look at the checksum in its first line; all of it without one."""
    first_line = text.partition("\n")[0]
    if "mr_damper_ros parameters" not in first_line and "sha256" not in first_line:
        return text  # written by hand
    header = _HEADER.match(text)
    if header is None:
        raise StateError(f"{path} is damaged: its first line is not complete")
    if int(header[1]) > _WITH_MEMORY:
        raise StateError(f"{path} was written by a newer version: update mr_damper_ros")
    body = text[header.end() :]
    # The checksum does not cover the version, but the version says what must be there.
    of_version = (int(header[1]) == _WITH_MEMORY) == (_MEMORY_LINE in body)
    if _digest(body) != header[2] or not of_version:
        raise StateError(
            f"{path} is damaged: its checksum is wrong (if it was edited on purpose, delete its "
            "first line)"
        )
    return body


def _lock_of(path: Path) -> Path:
    return path.with_name(f".{path.stem}.lock")


def _renamed(path: Path, without_ending: Path, ending: str) -> Path:
    """Give a file a name with this ending, and a number where there is one already."""
    number = 0
    while os.path.lexists(
        free := without_ending.with_name(f"{without_ending.name}.{ending}{number or ''}")
    ):
        number += 1
    try:
        path.rename(free)
    except OSError as error:
        raise StateError(f"cannot rename {path}: {error.strerror}") from error
    return free


def _unfinished_prefix(path: Path) -> str:
    """Begin of the name under which a file is written before it takes the place of the old one."""
    return f".{path.name}."


def _write_atomically(path: Path, text: str) -> None:
    descriptor, temporary = tempfile.mkstemp(prefix=_unfinished_prefix(path), dir=path.parent)
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
