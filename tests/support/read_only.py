"""Folders that may be read and not be written."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

NOBODY = 65534


@contextmanager
def read_only_copy(folder: Path) -> Iterator[Path]:
    """A copy of a folder in which this process can write nothing, root or not."""
    # pytest's own folders are closed to others.
    root = Path(tempfile.mkdtemp())
    copy = root / "copy"
    shutil.copytree(folder, copy)
    root.chmod(0o755)
    for path in (copy, *copy.rglob("*")):
        path.chmod(0o555 if path.is_dir() else 0o444)
    is_root = os.geteuid() == 0
    if is_root:  # root may write anywhere: be somebody else for a while
        os.seteuid(NOBODY)
    try:
        yield copy
    finally:
        if is_root:
            os.seteuid(0)
        for path in (copy, *copy.rglob("*")):
            if path.is_dir():
                path.chmod(0o755)
        shutil.rmtree(root)
