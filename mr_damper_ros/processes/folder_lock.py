"""A lock that one process holds as long as it lives, however it ends."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
from pathlib import Path

_NO_LOCKS = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS)
"""What a file system says that knows no locks, as some of networks do."""


class LockHeldError(Exception):
    """Another process holds the lock; ``holder`` is its number, 0 where it cannot be read."""

    def __init__(self, holder: int) -> None:
        super().__init__(f"held by process {holder}")
        self.holder = holder


class FolderLock:
    """A lock file that this process holds until :meth:`release` or its end.

    The file stays behind: it is the lock on it that counts, and the kernel releases that when the
    process ends, be it killed. Where the file system knows no locks, nobody is kept out.
    """

    def __init__(self, path: Path) -> None:
        """Take the lock; missing folders are made. Raises LockHeldError and OSError."""
        path.parent.mkdir(parents=True, exist_ok=True)
        # Not inherited by the processes that this one starts, which may outlive it.
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
        self._descriptor: int | None = os.open(path, flags, 0o666)
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            holder = _number(self._descriptor)
            self.release()
            raise LockHeldError(holder) from error
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                self.release()
                raise
        with contextlib.suppress(OSError):  # the number is for people
            os.ftruncate(self._descriptor, 0)
            os.pwrite(self._descriptor, b"%d\n" % os.getpid(), 0)

    def release(self) -> None:
        """Let another one have it."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


def _number(descriptor: int) -> int:
    try:
        return int(os.pread(descriptor, 20, 0))
    except (OSError, ValueError):
        return 0
