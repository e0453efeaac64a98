"""A training run in a folder: started, interrupted, resumed, evaluated."""

from __future__ import annotations

import copy
import importlib.metadata
import json
import os
import platform
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.logger import Logger, make_output_format
from stable_baselines3.common.vec_env import VecEnv

from .callbacks import OriginalGoalEvalCallback
from .checkpoint import load_tree, save_tree
from .envs import make_vec, object_id
from .files import atomic_write
from .follow_object import FollowObject, Report, stream_seed
from .goal_predictor import GoalPredictor
from .her_ddpg import HerDDPG
from .object_networks import FILE as OBJECT_FILE
from .object_networks import ObjectNetworks
from .policies import load_actor
from .rollout import Episodes, run_episodes

CONFIG, RESULT, EVALUATIONS = "config.json", "result.json", "evaluations.csv"
CHECKPOINT, PREDICTOR = "checkpoint.safetensors", "predictor"
OBJECT_STAGE = "object_stage.json"
POLICY, LAST_POLICY = "policy.safetensors", "last_policy.safetensors"
PACKAGES = ["sb3-follow-object", "stable-baselines3", "gymnasium", "gymnasium-robotics"]
PACKAGES += ["mujoco", "torch", "numpy"]

# Evaluation copies: the paper's 380 episodes are ten from each.
_EVAL_COPIES = 38


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
            from them, but the policy that is kept is the last one that validated best.
        n_final_episodes: fresh episodes of the final test of the kept policy, >= 1.
        checkpoint_minutes: wall time between two checkpoints, > 0; does not change the result.
        torch_threads: of PyTorch; the last bits of a result may depend on it.
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
    torch_threads: int = 1

    def __post_init__(self) -> None:
        for name in ("total_timesteps", "eval_every", "n_eval_episodes", "n_final_episodes"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least 1")
        if self.seed < 0:
            raise ValueError(f"seed is {self.seed}; it must be at least 0")
        if self.checkpoint_minutes <= 0.0:
            raise ValueError(f"checkpoint_minutes is {self.checkpoint_minutes}; it must be > 0")


class RunCallback(BaseCallback):
    """Keeps the best validated policy, writes checkpoints and reports progress.

    Args:
        run: what is trained.
        evaluation: its validation callback, which runs before this one.
        folder: of the run.
        checkpoint_minutes: wall time between checkpoints.
        progress: called with the current figures after each rollout.
    """

    def __init__(
        self,
        run: FollowObject,
        evaluation: OriginalGoalEvalCallback,
        folder: Path,
        checkpoint_minutes: float,
        progress: Callable[[dict[str, Any]], None],
    ):
        super().__init__()
        self.run = run
        self.evaluation = evaluation
        self.folder = folder
        self.checkpoint_minutes = checkpoint_minutes
        self.progress = progress
        self.best = -1.0
        self.stop_requested = False
        self._n_validated = 0
        self._last_checkpoint = time.monotonic()

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        assert self.run.model is not None
        if not all(bool(th.isfinite(w).all()) for w in self.run.model.actor.parameters()):
            steps = f"{self.run.env_steps:,}"
            raise RuntimeError(f"diverged: the policy is not finite after {steps} env steps")
        n_validated = self.evaluation.n_evaluations
        if n_validated > self._n_validated:
            self._n_validated = n_validated
            rate = self.evaluation.success_rate
            assert rate is not None
            if rate >= self.best:
                self.best = rate
                self.run.save_policy(self.folder / POLICY)
            self.logger.dump(self.run.env_steps)
        self.progress(
            {
                "env_steps": self.run.env_steps,
                "k_max": self.run.curriculum.k_max if self.run.imagine else None,
                "success_rate": self.evaluation.success_rate,
            }
        )

    def _on_rollout_start(self) -> None:
        # Between an update and the next rollout every copy is at the start of an episode.
        due = time.monotonic() - self._last_checkpoint > 60.0 * self.checkpoint_minutes
        if due or self.stop_requested:
            self.checkpoint()
        if self.stop_requested:
            raise KeyboardInterrupt

    def checkpoint(self) -> None:
        """Write everything that resuming needs."""
        state = {
            "run": self.run.state_dict(),
            "evaluation": self.evaluation.state_dict(),
            "best": self.best,
            "n_validated": self._n_validated,
        }
        save_tree(self.folder / CHECKPOINT, state)
        self._last_checkpoint = time.monotonic()

    def load(self, state: dict[str, Any]) -> None:
        """Continue from the callback's part of a checkpoint."""
        self.evaluation.load_state_dict(state["evaluation"])
        self.best = state["best"]
        self._n_validated = state["n_validated"]


def train(
    config: RunConfig,
    folder: str | os.PathLike[str],
    *,
    resume: bool = False,
    report: Report = print,
    progress: Callable[[dict[str, Any]], None] = lambda figures: None,
    command: str = "",
    object_stage_only: bool = False,
) -> dict[str, Any]:
    """Train in a folder and return its result, also written to result.json.

    Interrupting (Ctrl-C or SIGTERM) writes a checkpoint first; `resume=True` goes on from the last
    one and ends as the uninterrupted run would have.

    Args:
        config: what to train.
        folder: is created; must be empty or absent unless resuming.
        resume: whether to go on with what the folder holds.
        report: called with a sentence now and then.
        progress: called with env_steps, k_max and success_rate after each rollout.
        command: the command line to note in the result.
        object_stage_only: end where the robot's training would begin, and return nothing.

    Raises:
        ValueError: the folder holds another run, or none where one should be resumed.
        KeyboardInterrupt: after the checkpoint of an interrupted run.
    """
    folder = Path(folder)
    _check_folder(folder, config, resume)
    if resume and (folder / RESULT).exists():
        report(f"{folder} is finished already")
        return json.loads((folder / RESULT).read_text())
    th.set_num_threads(config.torch_threads)
    predictor = None
    if (folder / PREDICTOR).exists():
        predictor = GoalPredictor.load(folder / PREDICTOR, env_id=config.env_id)
    networks = None
    if (folder / OBJECT_FILE).exists():
        networks = ObjectNetworks.load(folder / OBJECT_FILE, env_id=config.env_id)
    settings = copy.deepcopy(config.settings)  # SB3 writes into policy_kwargs
    given = {"predictor": predictor, "object_networks": networks, **settings}
    run = FollowObject(config.env_id, seed=config.seed, report=report, **given)
    saved = None
    if resume and (folder / CHECKPOINT).exists():
        saved = load_tree(folder / CHECKPOINT)
    _check_algorithms(run)
    if not resume:
        claim(folder, config)
    elif saved is None:  # stopped before the first checkpoint: what was evaluated begins anew
        (folder / EVALUATIONS).unlink(missing_ok=True)
    stage_file = folder / OBJECT_STAGE
    if run.uses_networks and networks is None and stage_file.exists():
        raise ValueError(
            f"{folder / OBJECT_FILE} of the finished object stage is missing, which SLDR's reward "
            "reads; put it back, or start another run"
        )
    staged = stage_file.exists() and (predictor is not None or not run.imagine)
    if staged:
        stage = json.loads(stage_file.read_text())
        # A stage that other runs share may have more than this one uses.
        steps = "object_steps" if run.imagine else "policy_steps"
        run.object_steps, run.object_success = stage[steps], stage["object_success"]

    started = time.monotonic()
    model = run.prepare()
    if run.has_object_stage and not staged:
        if run.object_networks is not None:
            run.object_networks.save(folder / OBJECT_FILE)
        if run.predictor is not None:
            run.predictor.save(folder / PREDICTOR)
        stage = {"object_steps": run.object_steps, "policy_steps": run.policy_steps}
        stage["object_success"] = run.object_success
        stage["wall_s"] = round(time.monotonic() - started, 1)
        atomic_write(stage_file, json.dumps(stage).encode())
    if object_stage_only:
        run.close()
        return {}
    wall_before = json.loads(stage_file.read_text())["wall_s"] if stage_file.exists() else 0.0

    eval_env = evaluation_env(config.env_id, stream_seed(config.seed, "validation"), run.settings)
    evaluation = OriginalGoalEvalCallback(
        eval_env,
        config.n_eval_episodes,
        config.eval_every,
        csv_path=folder / EVALUATIONS,
        curriculum_callback=run.curriculum_callback,
        object_steps=run.object_steps,
        wall_before=wall_before,
    )
    callback = RunCallback(run, evaluation, folder, config.checkpoint_minutes, progress)
    if saved is not None:
        run.load_state_dict(saved["run"])
        callback.load(saved)
        report(f"resumed at {run.env_steps} env steps")
    model.set_logger(_logger(folder, run.env_steps))
    with _stop_on_signals(callback):
        run.learn(config.total_timesteps, callback=CallbackList([evaluation, callback]))

    run.save_policy(folder / LAST_POLICY)
    if not (folder / POLICY).exists():
        run.save_policy(folder / POLICY)
    episodes = evaluate(folder / POLICY, config.env_id, config.n_final_episodes, config.seed)
    result = {
        "task": config.env_id.removeprefix("FollowObject/").removesuffix("-v0"),
        "method": config.method,
        "seed": config.seed,
        "env_steps": run.env_steps,
        "object_steps": run.object_steps,
        "test_steps": run.test_steps,
        "wall_s": round(evaluation.wall_s, 1),
        "success_rate": episodes.success_rate,
        "episodes": config.n_final_episodes,
        "command": command,
        "k_max": run.curriculum.k_max if run.imagine else None,
    }
    atomic_write(folder / RESULT, json.dumps(result, indent=2).encode())
    (folder / CHECKPOINT).unlink(missing_ok=True)
    eval_env.close()
    run.close()
    return result


def evaluation_env(env_id: str, seed: int, settings: dict[str, Any] | None = None) -> VecEnv:
    """Return fresh copies of a task with its own goals and its sparse reward."""
    env = make_vec(env_id, _EVAL_COPIES, (settings or {}).get("n_threads"))
    env.seed(seed)
    return env


def evaluate(
    policy_file: str | os.PathLike[str], env_id: str, n_episodes: int = 380, seed: int = 0
) -> Episodes:
    """Test a saved policy: original goals, no noise, fresh episodes (section 5.2).

    The episodes' seeds are of a stream that neither training nor validation draws from.
    """
    env = evaluation_env(env_id, stream_seed(seed, "final test"))
    try:
        space = env.observation_space
        actor, _ = load_actor(policy_file, space, env.action_space)  # type: ignore[arg-type]
        return run_episodes(
            lambda obs: actor.predict(obs, deterministic=True)[0],
            env,
            n_episodes,
        )
    finally:
        env.close()


def trained_steps(folder: str | os.PathLike[str]) -> int | None:
    """Return the env steps that a run folder's training took; None where it does not say."""
    folder = Path(folder)
    if (folder / RESULT).exists():
        return int(json.loads((folder / RESULT).read_text())["env_steps"])
    if (folder / EVALUATIONS).exists():
        rows = (folder / EVALUATIONS).read_text().splitlines()[1:]
        return int(rows[-1].split(",")[0]) if rows else None
    return None


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


def _check_folder(folder: Path, config: RunConfig, resume: bool) -> None:
    """Raise unless the folder is this run's or, where one starts, absent or empty."""
    if not resume:
        if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
            raise ValueError(f"{folder} is not empty; resume the run in it or give another folder")
        return
    if not (folder / CONFIG).exists():
        raise ValueError(f"{folder} holds no run to resume")
    different = difference(json.loads((folder / CONFIG).read_text()), asdict(config))
    if different is not None:
        name, kept, wanted = different
        raise ValueError(
            f"the run in {folder} has {name} {kept!r}, not {wanted!r}; "
            "resume it as it is or start another in another folder"
        )


def difference(kept: dict[str, Any], wanted: dict[str, Any]) -> tuple[str, Any, Any] | None:
    """Return the first setting that differs, by its dotted name, and its two values."""
    ours, theirs = _flat(kept), _flat(json.loads(json.dumps(wanted)))
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


def _check_algorithms(run: FollowObject) -> None:
    """Build both algorithms once, in small, so that a wrong argument is not found hours later."""
    small = {"policy": "MultiInputPolicy", "buffer_size": 10 * run.env.num_envs}
    settings = run.settings
    envs = [(run.env, settings["algorithm"])]
    if run.has_object_stage:
        object_env = make_vec(object_id(run.env_id), 1)
        envs.append((object_env, settings["object_algorithm"]))
    for env, arguments in envs:
        arguments = copy.deepcopy(arguments)
        if run.uses_networks:  # what it needs is not there yet; its settings have been checked
            arguments.pop("auxiliary", None)
        replay = {**(arguments.get("replay_buffer_kwargs") or {}), "imagined_ratio": 0.0}
        try:
            HerDDPG(env=env, **{**arguments, **small, "replay_buffer_kwargs": replay})
        except (TypeError, AssertionError) as error:
            raise ValueError(f"the algorithm cannot be built: {error}") from error
    if run.has_object_stage:
        object_env.close()


def claim(folder: Path, config: RunConfig) -> None:
    """Create a run's folder with its config and versions: what `train(resume=True)` asks for."""
    folder.mkdir(parents=True, exist_ok=True)
    versions: dict[str, str | None] = {n: importlib.metadata.version(n) for n in PACKAGES}
    versions |= {"python": platform.python_version(), "commit": source_commit()}
    atomic_write(folder / "versions.json", json.dumps(versions, indent=2).encode())
    atomic_write(folder / CONFIG, json.dumps(asdict(config), indent=2).encode())


def _logger(folder: Path, env_steps: int) -> Logger:
    """CSV and TensorBoard; a resumed run begins another CSV rather than overwrite the first."""
    formats = ["csv"]
    try:
        import tensorboard  # noqa: F401

        formats.append("tensorboard")
    except ImportError:
        pass
    suffix = f"_{env_steps}"
    return Logger(str(folder), [make_output_format(f, str(folder), suffix) for f in formats])


@contextmanager
def _stop_on_signals(callback: RunCallback) -> Iterator[None]:
    """Turn SIGINT and SIGTERM into a checkpoint at the next rollout's start."""

    def request(signum: int, frame: Any) -> None:
        if callback.stop_requested:  # asked twice: stop at once
            raise KeyboardInterrupt
        callback.stop_requested = True

    earlier = {sig: signal.signal(sig, request) for sig in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for sig, handler in earlier.items():
            signal.signal(sig, handler)
