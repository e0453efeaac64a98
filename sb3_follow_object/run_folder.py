"""A run's folder: what is in it, whose it is, and the checkpoints that it keeps."""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import subprocess
import threading
import time
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from .checkpoint import Camera, Snapshot, load_tree
from .envs import physics_id
from .files import LOCK, atomic_write
from .follow_object import FollowObject
from .goal_predictor import GoalPredictor
from .object_networks import FILE as OBJECT_FILE
from .object_networks import ObjectNetworks
from .predictor_files import FACTS_FILE
from .reports import Report, Trouble

CONFIG, RESULT, EVALUATIONS = "config.json", "result.json", "evaluations.csv"
PREDICTOR, OBJECT_STAGE = "predictor", "object_stage.json"
POLICY, BEST_POLICY = "policy.safetensors", "best_policy.safetensors"
CHECKPOINTS = "checkpoint-*.safetensors"
VERSIONS = "versions.json"
CROSS_TESTS = "cross_tests.json"  # the policy on other tasks
COMMAND = "command.txt"  # what started the run, and what gave it other steps later
PACKAGES = ["sb3-follow-object", "stable-baselines3", "gymnasium", "gymnasium-robotics"]
PACKAGES += ["mujoco", "torch", "numpy"]


# The whole numbers of a run and the least that each may be.
_WHOLE_NUMBERS = {"seed": 0, "total_timesteps": 1, "eval_every": 1, "n_eval_episodes": 1}
_WHOLE_NUMBERS |= {"n_final_episodes": 1, "keep_checkpoints": 1, "torch_threads": 1}


# What everything that reads a result needs of it.
_RESULT: dict[str, type] = {"env_steps": int, "wall_s": float, "success_rate": float}


@dataclass(frozen=True)
class RunConfig:
    """What decides a run.

    Attributes:
        env_id: the task.
        method: name of the method, for tables.
        seed: decides every random stream of the run, >= 0.
        total_timesteps: env steps in all, object stage and curriculum tests counted.
        settings: keyword arguments of `FollowObject` besides env_id and seed.
        eval_every: env steps between two validations on original goals, >= 1.
        n_eval_episodes: episodes a validation, >= 1; its steps are not counted, nothing learns
            from them.
        n_final_episodes: fresh episodes of the last policy's final test, >= 1.
        checkpoint_minutes: wall time between two checkpoints, > 0; does not change the result.
        keep_checkpoints: how many of the last checkpoints are kept, >= 1.
        keep_last_checkpoint: whether a finished run keeps one, to be given more steps later.
        torch_threads: of PyTorch in the robot's gradient steps, >= 1; all else takes one.
        module: that registers the task when it is imported; None for the package's own tasks and
            those that gymnasium knows by itself.
    """

    env_id: str
    method: str = "fo"
    seed: int = 0
    total_timesteps: int = 1_000_000
    settings: dict[str, Any] = field(default_factory=dict)
    eval_every: int = 50_000
    n_eval_episodes: int = 76
    n_final_episodes: int = 380
    checkpoint_minutes: float = 5.0
    keep_checkpoints: int = 2
    keep_last_checkpoint: bool = False
    torch_threads: int = 1
    module: str | None = None

    def __post_init__(self) -> None:
        for name, low in _WHOLE_NUMBERS.items():
            value = getattr(self, name)
            if type(value) is not int or value < low:
                raise ValueError(f"{name} is {value!r}; it must be at least {low}")
        if type(self.keep_last_checkpoint) is not bool:
            raise ValueError(
                f"keep_last_checkpoint is {self.keep_last_checkpoint!r}; it must be true or false"
            )
        if not self.checkpoint_minutes > 0.0:
            raise ValueError(f"checkpoint_minutes is {self.checkpoint_minutes}; it must be > 0")

    @property
    def full_id(self) -> str:
        """The task's id as the command line takes it, with the module before it."""
        return self.env_id if self.module is None else f"{self.module}:{self.env_id}"


# ---- whose folder it is -----------------------------------------------------------------------


def check_empty(folder: Path) -> None:
    """Raise a ValueError unless a run can start in the folder."""
    if folder.exists() and not (folder.is_dir() and all(map(_is_of_a_start, folder.iterdir()))):
        raise ValueError(f"{folder} is not empty; resume the run in it or give another folder")


def _is_of_a_start(path: Path) -> bool:
    """Whether a file is what a start leaves that did not come to the configuration."""
    half_written = path.name.startswith(".") and path.suffix == ".tmp"
    return half_written or path.name in (LOCK, VERSIONS, COMMAND)


def check_same_run(folder: Path, config: RunConfig) -> None:
    """Raise a ValueError unless the folder holds the run of the configuration, steps apart."""
    path = folder / CONFIG
    if not path.exists():
        raise ValueError(f"{folder} holds no run to resume")
    try:
        kept = RunConfig(**json.loads(path.read_text()))
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not the configuration of a run ({error})") from error
    same_steps = replace(kept, total_timesteps=config.total_timesteps)
    different = difference(asdict(same_steps), asdict(config))
    if different is not None:
        name, ours, theirs = different
        raise ValueError(
            f"the run in {folder} has {name} {ours!r}, not {theirs!r}; "
            "resume it as it is or start another in another folder"
        )


def difference(kept: dict[str, Any], wanted: dict[str, Any]) -> tuple[str, Any, Any] | None:
    """Return the first setting that differs, by its dotted name, and its two values."""
    ours, theirs = (_flat(json.loads(json.dumps(settings))) for settings in (kept, wanted))
    for name in {**ours, **theirs}:
        if ours.get(name) != theirs.get(name):
            return name, ours.get(name), theirs.get(name)
    return None


def _flat(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested settings by their dotted names."""
    flat: dict[str, Any] = {}
    for name, value in tree.items():
        nested = _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else None
        flat |= {f"{prefix}{name}": value} if nested is None else nested
    return flat


def claim(folder: Path, config: RunConfig, command: str = "") -> None:
    """Create a run's folder with its config and versions: what `train(resume=True)` asks for."""
    folder.mkdir(parents=True, exist_ok=True)
    check_empty(folder)  # again, now that no other process can come in between
    versions: dict[str, str | None] = {n: importlib.metadata.version(n) for n in PACKAGES}
    versions |= {"python": platform.python_version(), "commit": source_commit()}
    atomic_write(folder / VERSIONS, json.dumps(versions, indent=2).encode())
    if command:
        atomic_write(folder / COMMAND, f"{command}\n".encode())
    atomic_write(folder / CONFIG, json.dumps(asdict(config), indent=2).encode())


def take_steps(folder: Path, config: RunConfig, command: str = "") -> None:
    """Note in a run's folder the steps that it is resumed with, where they are others."""
    kept = RunConfig(**json.loads((folder / CONFIG).read_text()))
    if kept.total_timesteps == config.total_timesteps:
        return
    if command and (folder / COMMAND).exists():
        earlier = (folder / COMMAND).read_text()
        atomic_write(folder / COMMAND, f"{earlier}{command}\n".encode())
    atomic_write(folder / CONFIG, json.dumps(asdict(config), indent=2).encode())


def noted_command(folder: Path, command: str = "") -> str:
    """Return what made a run, as one line of a shell; `command` where its folder does not say."""
    if not (folder / COMMAND).exists():
        return command
    return " && ".join((folder / COMMAND).read_text().splitlines())


def finished_result(folder: Path, config: RunConfig) -> dict[str, Any] | None:
    """Return the result of a run that has had its steps; None for one that can go on.

    Raises:
        ValueError: it ended after fewer and kept no checkpoint to go on from.
    """
    if not (folder / RESULT).exists():
        return None
    result = read_result(folder)
    if result["env_steps"] >= config.total_timesteps:
        return result
    if not checkpoint_files(folder):
        raise ValueError(
            f"the run in {folder} ended after {result['env_steps']} env steps and kept no "
            "checkpoint to go on from; one started with --set keep_last_checkpoint=true keeps it"
        )
    return None


def read_result(folder: Path) -> dict[str, Any]:
    """Return the content of a run's result.json.

    Raises:
        ValueError: the file is damaged.
    """
    path = folder / RESULT
    try:
        result = json.loads(path.read_text())
        for name, kind in _RESULT.items():
            result[name] = kind(result[name])
        return dict(result)
    except (OSError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not the result of a run ({error})") from error


def source_commit() -> str | None:
    """Return the commit of the package's source tree; None for an installed wheel."""
    command = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        run = subprocess.run(
            command, cwd=Path(__file__).parent, capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return run.stdout.strip()


def trained_steps(folder: str | os.PathLike[str]) -> int | None:
    """Return the env steps that a run folder's training took; None where it does not say."""
    folder = Path(folder)
    if (folder / RESULT).exists():
        return int(read_result(folder)["env_steps"])
    if (folder / EVALUATIONS).exists():
        rows = (folder / EVALUATIONS).read_text().splitlines()[1:]
        try:
            return int(rows[-1].split(",")[0]) if rows else None
        except ValueError as error:
            raise ValueError(f"{folder / EVALUATIONS} is damaged: {error}") from error
    return None


# ---- what the first two stages leave ----------------------------------------------------------


def save_object_stage(folder: Path, run: FollowObject, wall_s: float) -> None:
    """Keep what the object stage made and what it cost; the last file says that all are there."""
    stage = run.object_stage
    if stage.networks is not None:
        stage.networks.save(folder / OBJECT_FILE)
    if stage.predictor is not None:
        stage.predictor.save(folder / PREDICTOR)
    facts = {
        "object_steps": stage.steps,
        "policy_steps": stage.policy_steps,
        "object_success": stage.success,
        "wall_s": round(wall_s, 1),
    }
    atomic_write(folder / OBJECT_STAGE, json.dumps(facts).encode())


def load_object_stage(folder: Path, run: FollowObject, saved: Any) -> float | None:
    """Give a run what its folder's object stage made.

    Args:
        folder: of the run.
        run: is changed.
        saved: the checkpoint that the run goes on from, None without one.

    Returns:
        The seconds that the stage took; None where it has not ended.

    Raises:
        ValueError: a file is missing, damaged or for another task.
    """
    if not run.has_object_stage:
        return 0.0
    stage = run.object_stage
    path = folder / OBJECT_STAGE
    robot_has_begun = isinstance(saved, dict) and saved.get("stage") == "robot"
    if not path.exists() and not robot_has_begun:
        return None
    for needed, file, purpose in (
        (True, path, "says what it cost"),
        (run.imagine, folder / PREDICTOR / FACTS_FILE, "the robot's goals come from"),
        (stage.needs_networks, folder / OBJECT_FILE, "SLDR's reward reads"),
    ):
        if needed and not file.exists():
            raise ValueError(
                f"{file} of the finished object stage is missing, which {purpose}; "
                "put it back, or start another run"
            )
    if run.imagine:
        stage.use_predictor(GoalPredictor.load(folder / PREDICTOR, env_id=run.env_id))
    if stage.needs_networks:
        physics = physics_id(run.env_id)
        stage.networks = ObjectNetworks.load(folder / OBJECT_FILE, run.env_id, physics)
    try:
        facts = json.loads(path.read_text())
        # A stage that other runs share may have more than this one uses.
        stage.steps = int(facts["object_steps" if run.imagine else "policy_steps"])
        stage.success = float(facts["object_success"])
        return float(facts["wall_s"])
    except (OSError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"{path} does not say what the object stage cost ({error})") from error


# ---- checkpoints ------------------------------------------------------------------------------


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


class Checkpoints:
    """Writes a run's checkpoints while the training goes on, and keeps the last of them.

    The training waits only while its state is copied; hashing and writing are a thread's. The
    copy's memory, as much as the replay buffer's, is kept for the next one.

    Args:
        folder: of the run.
        keep: how many to keep, >= 1.
        report: called with a sentence for each checkpoint, or with what went wrong.
    """

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
            tree: as `save_tree` takes it.
        """
        self.wait()
        started = time.perf_counter()
        snapshot = self._camera.take(tree)
        stalled = time.perf_counter() - started
        self._thread = threading.Thread(target=self._write, args=(env_steps, snapshot, stalled))
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

    def _write(self, env_steps: int, snapshot: Snapshot, stalled: float) -> None:
        try:
            path = self.folder / CHECKPOINTS.replace("*", f"{env_steps:012}")
            size = snapshot.write(path)
            self._drop_old(path)
            self._outcome = (
                f"checkpoint at {env_steps} env steps: {size / 1e6:.1f} MB, "
                f"training stood still for {stalled:.2f} s"
            )
        except OSError as error:
            kept = checkpoint_files(self.folder)
            rest = f"the last good one is {kept[-1].name}" if kept else "there is no other so far"
            self._outcome = Trouble(
                f"the checkpoint at {env_steps} env steps could not be written "
                f"({error.strerror or error}); {rest}"
            )

    def _drop_old(self, newest: Path) -> None:
        """Keep the last ones up to the one just written; later ones are of a past that was left."""
        files = checkpoint_files(self.folder)
        up_to_now = [path for path in files if path <= newest]
        for path in {*files} - {*up_to_now[-self.keep :]}:
            path.unlink()
