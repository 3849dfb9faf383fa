"""A file in shared memory that one process writes and any other may read."""

from __future__ import annotations

import contextlib
import errno
import mmap
import os
from pathlib import Path


def shared_path(name: str) -> Path:
    """Return a shared file's path: in ``RUNTIME_DIRECTORY`` (of systemd), else in this user's directory in /dev/shm."""
    runtime = os.environ.get("RUNTIME_DIRECTORY", "").split(":")[0]
    return Path(runtime or f"/dev/shm/timberhand-{os.getuid()}") / name  # see make_own_folder  # nosec B108


def make_own_folder(folder: Path) -> None:
    """Make a folder for files and sockets that others may find; one that another user made first is not trusted.

    Raises:
        OSError: It cannot be made, or belongs to another user than this one and root.
    """
    folder.mkdir(mode=0o755, parents=True, exist_ok=True)
    if folder.stat().st_uid not in (os.getuid(), 0):
        raise PermissionError(
            errno.EPERM, "the folder belongs to another user, who could change what is in it", str(folder)
        )


class SharedFile:
    """Owns the file at ``path``, ``size`` bytes of zeros in ``map``.  Everyone may read it; it must hold no secret."""

    __slots__ = ("_inode", "_path", "map")

    def __init__(self, path: Path, size: int) -> None:
        """Create the file; raises OSError if it cannot be created."""
        make_own_folder(path.parent)
        # A new file each time: a reader of a former process's file keeps its mapping.
        with contextlib.suppress(FileNotFoundError):
            path.unlink()
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        try:
            os.fchmod(descriptor, 0o644)  # independent of the umask
            os.posix_fallocate(descriptor, 0, size)  # no page fault and no full file system at the first write
            self.map = mmap.mmap(descriptor, size)
            self._inode = os.fstat(descriptor).st_ino
        finally:
            os.close(descriptor)
        self._path = path

    def close(self) -> None:
        """Remove the file, unless another process owns it by now; may be called twice."""
        with contextlib.suppress(OSError):
            if self._path.stat().st_ino == self._inode:
                self._path.unlink()
        self.map.close()
