"""Atomic and deferred writing of files, values for JSON, and locks that end with their process."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import math
import os
import stat
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Generic, TypeVar

from mr_damper_ros.processes.dependencies import missing_dependency

T = TypeVar("T")


def write_text(path: Path, text: str, *, durable: bool = False) -> None:
    """As :func:`write_bytes`, in UTF-8."""
    write_bytes(path, text.encode(), durable=durable)


def write_bytes(path: Path, content: bytes, *, durable: bool = False) -> None:
    """Write a file completely or not at all; missing folders are created. Raises OSError.

    A ``durable`` file also survives a power failure right after the call.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    fresh = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with named_errors(path):
            fresh.write_bytes(content)
        if durable:
            _sync(fresh)
        fresh.replace(path)
    finally:
        fresh.unlink(missing_ok=True)
    if durable:
        _sync(path.parent)  # the new name


@contextlib.contextmanager
def named_errors(path: Path) -> Iterator[None]:
    """Add the path to an OSError that names no file, as the error of a full disk."""
    try:
        yield
    except OSError as error:
        error.filename = error.filename or str(path)
        raise


def reason_of(error: BaseException) -> str:
    """An exception in words, for a user: of an error of the system the file and the remedy."""
    if isinstance(error, ModuleNotFoundError) and (sentence := missing_dependency(error)):
        return sentence
    if isinstance(error, OSError) and error.strerror:
        where = f"{error.filename}: " if error.filename else ""
        remedy = ": free space there (df -h lists all disks and the shared memory /dev/shm)"
        is_full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        return f"{where}{error.strerror}{remedy if is_full else ''}"
    if isinstance(error, MemoryError):
        return "there is not enough memory for these data: use a part of them"
    plain = isinstance(error, (OSError, ValueError))
    return str(error) if plain else f"{type(error).__name__}: {error}"


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def json_ready(value: Any) -> Any:
    """A value converted to types that JSON can hold; numbers that are not finite become null.

    Arrays and numbers of NumPy become lists and numbers.
    """
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): json_ready(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_ready(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


class LockHeldError(ValueError):
    """Another process holds the lock; ``holder`` is its process id, 0 if it cannot be read."""

    def __init__(self, folder: Path, holder: int) -> None:
        super().__init__(
            f"{folder} is in use by another program (process {holder}): choose another folder, or "
            "wait for the end of that program"
        )
        self.holder = holder


class FolderLock:
    """A lock file that this process holds until :meth:`release` or its end.

    Only the lock counts; the file itself remains. The kernel releases the lock when the process
    ends, even if it is killed. On a file system without locks, no other process is excluded.
    """

    def __init__(self, path: Path) -> None:
        """Take the lock; missing folders are created. Raises LockHeldError and OSError."""
        path.parent.mkdir(parents=True, exist_ok=True)
        # The lock is not inherited by child processes, which may outlive this one.
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
        self._descriptor: int | None = os.open(path, flags, 0o666)
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            try:
                holder = int(os.pread(self._descriptor, 20, 0))
            except (OSError, ValueError):
                holder = 0
            self.release()
            raise LockHeldError(path.parent, holder) from error
        except OSError as error:
            # Some network file systems have no locks.
            if error.errno not in (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS):
                self.release()
                raise
        with contextlib.suppress(OSError):  # the process id is only shown in messages
            os.ftruncate(self._descriptor, 0)
            os.pwrite(self._descriptor, b"%d\n" % os.getpid(), 0)

    def release(self) -> None:
        """Release the lock for other processes."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


_KINDS = {
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFDIR: "a folder",
}


def irregularity(path: Path) -> str:
    """What a path is if it is not a regular file, in words; empty for a file. Follows links.

    Raises OSError if the path does not exist.
    """
    kind = stat.S_IFMT(path.stat().st_mode)
    return "" if kind == stat.S_IFREG else _KINDS.get(kind, "no file")


class BackgroundWriter(Generic[T]):
    """Calls ``write`` with the newest item in its own thread; older pending items are skipped.

    ``write`` may raise OSError or ValueError; :attr:`fault` is the message of the last call.
    """

    def __init__(self, write: Callable[[T], object]) -> None:
        self._write = write
        self._changed = threading.Condition()
        self._newest: tuple[int, T] | None = None
        self.given = 0
        """Number of items given so far, which is also the number of the newest item."""
        self.done = 0
        """Number of the newest item that was written or failed; older items count as done."""
        self.fault = ""
        self._thread = threading.Thread(target=self._work, name="state", daemon=True)

    def __deepcopy__(self, memo: object) -> BackgroundWriter[T]:
        """A copy of an engine, as a trial makes, shares the writer."""
        return self

    def keep(self, item: T) -> None:
        """Write this item soon."""
        with self._changed:
            if not self.given:
                self._thread.start()
            self.given += 1
            self._newest = (self.given, item)
            self._changed.notify_all()

    def wait(self, timeout: float) -> bool:
        """Wait until the newest item is written; False if that takes more than ``timeout`` [s]."""
        with self._changed:
            return self._changed.wait_for(lambda: self.done == self.given, timeout)

    def _work(self) -> None:
        while True:
            with self._changed:
                while self._newest is None:
                    self._changed.wait()
                (number, item), self._newest = self._newest, None
            fault = ""
            try:
                self._write(item)
            except (OSError, ValueError) as error:
                fault = reason_of(error)
            with self._changed:
                self.fault, self.done = fault, number
                self._changed.notify_all()


class Outbox(Generic[T]):
    """Items that are released in order, each once its state is written to disk.

    A slow disk delays them only for ``patience`` seconds; then an item is released anyway.
    """

    def __init__(self, patience: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._patience = patience
        self._clock = clock
        self._waiting: deque[tuple[T, int, float]] = deque()
        self.late = 0
        """Number of items released before their state was written."""

    def add(self, item: T, number: int) -> None:
        """Add an item that waits for the state of this number, as counted by a BackgroundWriter."""
        self._waiting.append((item, number, self._clock() + self._patience))

    def take(self, written: int) -> list[T]:
        """Remove and return the released items; ``written``: number of the last state on disk."""
        ready = []
        while self._waiting:
            item, number, deadline = self._waiting[0]
            if number > written:
                if self._clock() < deadline:
                    break
                self.late += 1
            self._waiting.popleft()
            ready.append(item)
        return ready

    def take_all(self) -> list[T]:
        """Remove and return all items, whether their states are written or not."""
        items = [item for item, _, _ in self._waiting]
        self._waiting.clear()
        return items
