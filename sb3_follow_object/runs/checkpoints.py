"""The checkpoints that a run's folder keeps."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

from ..common.array_trees import Camera, Snapshot, load_tree
from ..common.copies import NoCopies
from ..common.reports import Report, Trouble, reason

CHECKPOINTS = "checkpoint-*.safetensors"


def checkpoint_files(folder: Path) -> list[Path]:
    """Return a run's checkpoints, the newest last."""
    return sorted(folder.glob(CHECKPOINTS))  # their names hold the steps, with leading zeros


def load_newest(folder: Path, report: Report) -> Any:
    """Return the newest checkpoint that is whole, reporting those that are not; None without any.

    Raises:
        ValueError: there are checkpoints, but all are damaged.
    """
    files = checkpoint_files(folder)
    for path in reversed(files):
        try:
            return load_tree(path)
        except ValueError as error:
            reason = str(error)
            report(Trouble(f"{reason}; taking the one before it"))
    if files:
        raise ValueError(
            f"every checkpoint in {folder} is damaged; remove them to start the run again"
        )
    return None


class Checkpoints(NoCopies):
    """Writes a run's checkpoints while the training goes on, and keeps the last of them.

    The training waits only while its state is copied; hashing and writing are a thread's. The
    copy's memory, as much as the replay buffer's, is kept for the next one.

    Args:
        folder: of the run.
        keep: how many to keep, >= 1.
        report: called with a sentence for each checkpoint, or with what went wrong.
    """

    no_copies = "Checkpoints write one folder and cannot be copied: make others for another run"

    def __init__(self, folder: Path, keep: int, report: Report):
        self.folder = folder
        self.keep = keep
        self.report = report
        self._camera = Camera()
        self._thread: threading.Thread | None = None
        self._outcome = ""

    def take_memory(self, tree: Any) -> None:
        """Take the memory for copies of a state like this one, before the training begins."""
        self._camera.take(tree)

    def write(self, env_steps: int, tree: Any) -> None:
        """Copy a state and begin to write it; where that fails, say so and go on.

        Args:
            env_steps: of the run so far; names the file.
            tree: as `save_tree` takes it; its "stage" says whose steps they are.
        """
        self.wait()
        started = time.perf_counter()
        snapshot = self._camera.take(tree)
        stalled = time.perf_counter() - started
        # The object's are of its training alone, as its tests are told, without F_phi's paths.
        whose = " of the object's training" if tree.get("stage") == "object" else ""
        self._thread = threading.Thread(
            target=self._write, args=(env_steps, whose, snapshot, stalled)
        )
        self._thread.start()

    def poll(self) -> None:
        """Report a checkpoint that has been written meanwhile."""
        if self._thread is not None and not self._thread.is_alive():
            self.wait()

    def wait(self) -> None:
        """Wait until the last checkpoint is written, and report it."""
        if self._thread is None:
            return
        self._thread.join()
        self._thread = None
        self.report(self._outcome)

    def remove(self, keep_last: bool = False) -> None:
        """Remove all checkpoints, or all but the last: the run has its result."""
        self.wait()
        files = checkpoint_files(self.folder)
        for path in files[:-1] if keep_last else files:
            path.unlink()

    def _write(self, env_steps: int, whose: str, snapshot: Snapshot, stalled: float) -> None:
        try:
            path = self.folder / CHECKPOINTS.replace("*", f"{env_steps:012}")
            size = snapshot.write(path)
            self._drop_old(path)
            self._outcome = (
                f"checkpoint at {env_steps} env steps{whose}: {size / 1e6:.1f} MB, "
                f"training stood still for {stalled:.2f} s"
            )
        except Exception as error:  # nobody else would hear of it
            kept = checkpoint_files(self.folder)
            rest = f"the last good one is {kept[-1].name}" if kept else "there is no other so far"
            self._outcome = Trouble(
                f"the checkpoint at {env_steps} env steps{whose} could not be written "
                f"({reason(error)}); {rest}"
            )

    def _drop_old(self, newest: Path) -> None:
        """Keep the last ones up to the one just written; later ones are of a past that was left."""
        files = checkpoint_files(self.folder)
        up_to_now = [path for path in files if path <= newest]
        for path in {*files} - {*up_to_now[-self.keep :]}:
            path.unlink()
