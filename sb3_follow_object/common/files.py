"""Writing files so that a crash leaves either the old content or the new, never a part."""

from __future__ import annotations

import errno
import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

LOCK = ".lock"
# Letters of a name that its temporary file begins with: file systems take 255 bytes in all.
NAME_LETTERS = 40
# What file systems without locks say to who asks for one.
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)


@contextmanager
def atomic_file(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a file whose content takes the name ``path`` as a whole or not at all.

    The bytes go to a temporary file in the same folder (a rename is atomic only within one file
    system), reach the disk, and then take the name. The temporary file is removed on any error.

    Args:
        path: file to create or replace; its folder must exist.

    Raises:
        OSError: the folder is missing or cannot be written; ``path`` is then as it was.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name[:NAME_LETTERS]}.{uuid.uuid4().hex}.tmp")
    try:
        with open(temporary, "xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException as error:
        with suppress(OSError):  # where nothing can be written there is nothing to remove either
            temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename == str(temporary):
            error.filename = str(path)  # the name that whoever asked knows
        raise
    if os.name == "posix":  # the rename itself survives a power cut only once the folder is synced
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def atomic_write(path: str | os.PathLike[str], data: bytes) -> None:
    """Write ``data`` to ``path`` as a whole or not at all, as `atomic_file` does."""
    with atomic_file(path) as file:
        file.write(data)


def is_left_over(path: Path) -> bool:
    """Whether a file is what a writer that was killed leaves: a lock, or a temporary file."""
    return path.name == LOCK or (path.name.startswith(".") and path.suffix == ".tmp")


def remove_half_written(folder: str | os.PathLike[str]) -> None:
    """Remove the temporary files of writers that were killed; there must be no other writer."""
    for left in Path(folder).glob(".*.tmp"):
        if not left.is_dir():  # a folder is another writer's, such as one for the hub
            left.unlink(missing_ok=True)


@contextmanager
def lock(folder: str | os.PathLike[str], *, wait: bool) -> Iterator[None]:
    """Hold a folder for one process; the lock ends with the process, however that ends.

    Where there are no such locks (not POSIX, some network file systems) nothing is held.

    Args:
        folder: must exist; a file named .lock is made in it.
        wait: whether to wait for another process that holds the folder.

    Raises:
        ValueError: another process holds it, and ``wait`` is False.
    """
    try:
        import fcntl
    except ImportError:
        yield
        return
    with open(Path(folder) / LOCK, "a", encoding="utf-8") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError as error:
            raise ValueError(
                f"another process works in {folder}; wait until it ends, or give another folder"
            ) from error
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                raise
        yield
