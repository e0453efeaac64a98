"""A folder for the Hugging Face hub: model card, policy without pickle, configuration, results."""

from __future__ import annotations

import json
import os
import shlex
from dataclasses import asdict, replace
from datetime import datetime, timezone
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import gymnasium as gym
import yaml
from stable_baselines3.td3.policies import Actor

from ..common.files import atomic_write, is_left_over
from ..ddpg.actor_files import load_actor
from ..envs.robot_copies import robot_vec_env
from ..settings.presets import load_config
from ..settings.run_config import CONFIG, RunConfig
from ..settings.stages import StageSettings
from .evaluation import evaluate
from .run_folder import POLICY, RESULT, VERSIONS, noted_command, read_result

# The names that SB3's users know from the hub.
CARD, RESULTS, FILM = "README.md", "results.json", "replay.mp4"

_TEXT = """
# **{method}** agent playing **{env_id}**

A policy for {env_id}, trained with [Stable-Baselines3](https://github.com/DLR-RM/stable-baselines3)
and sb3-follow-object by the method `{method}`{imagined}.

{success:.3f} of {episodes} episodes reach their goal: original goals, no noise, after
{env_steps} env steps.

## Usage

```python
import gymnasium as gym
from huggingface_hub import snapshot_download
from sb3_follow_object import load_hub_folder

actor, config = load_hub_folder(snapshot_download("USER/NAME"))  # nothing is unpickled
env = gym.make(config.env_id)
obs, info = env.reset()
action, _ = actor.predict(obs, deterministic=True)
```

## Training

```
{command}
```

`{config}` holds every setting, `{versions}` what it ran on.
"""

_PATHS = ("--run", "--config")  # options whose values say where things lie on this machine
_IMAGINED = ": in training it is shown goals on the way that the object would take by itself"


def write_hub_folder(run: str | os.PathLike[str], folder: str | os.PathLike[str]) -> None:
    """Write a folder that can be pushed to the Hugging Face hub as it is.

    It holds policy.safetensors, config.json, versions.json, results.json and a model card. The
    policy is tested for it as it was at the run's end, on the same episodes: the very bytes that
    the folder then holds, whatever a training writes meanwhile. The folder appears as a whole.

    Args:
        run: folder of a run; it need not be finished.
        folder: must be absent or empty.

    Raises:
        OSError: the folder cannot be written; it is then as it was.
        ValueError: the folder is not empty, or `run` holds no run that has a policy, or a damaged
            file.
    """
    run, folder = Path(run), Path(folder)
    config = load_config(run)
    check_new(folder)
    folder = folder.resolve()
    made = read_result(run) if (run / RESULT).exists() else {}
    command = noted_command(run, str(made.get("command") or ""))
    files = {
        POLICY: _policy(run),
        CONFIG: json.dumps(asdict(config), indent=2).encode(),
    }
    if (run / VERSIONS).exists():
        files[VERSIONS] = (run / VERSIONS).read_bytes()
    disk = next(path for path in (folder, *folder.parents) if path.exists())
    with TemporaryDirectory(dir=disk, prefix=".hub-", suffix=".tmp") as temporary:
        new = Path(temporary) / "new"
        new.mkdir()
        for name, content in files.items():
            atomic_write(new / name, content)
        results = _tested(new / POLICY, run / POLICY, config)
        atomic_write(new / RESULTS, json.dumps(results, indent=2).encode())
        atomic_write(new / CARD, _card(made.get("env_steps"), command, config, results).encode())
        _move(new, folder)


def _policy(run: Path) -> bytes:
    """Return the file of a run's policy."""
    try:
        return (run / POLICY).read_bytes()
    except FileNotFoundError as error:
        raise ValueError(f"there is no file {run / POLICY}") from error


def _tested(policy: Path, of: Path, config: RunConfig) -> dict[str, Any]:
    """Return what the hub is told of a policy's test; errors name the file that it is a copy of."""
    n_episodes = config.n_final_episodes
    try:
        episodes = evaluate(policy, config.env_id, n_episodes, config.seed)
    except ValueError as error:
        raise ValueError(str(error).replace(str(policy), str(of))) from error
    return {
        "env_id": config.env_id,
        "success_rate": episodes.success_rate,
        "mean_reward": float(episodes.returns.mean()),
        "std_reward": float(episodes.returns.std()),
        "is_deterministic": True,
        "n_eval_episodes": n_episodes,
        "eval_datetime": datetime.now(timezone.utc).isoformat(timespec="seconds"),
    }


def _move(new: Path, folder: Path) -> None:
    """Let a folder's files be those of one that is absent or empty, on the same disk."""
    if folder.exists():  # a mounted one could not be renamed over
        for path in new.iterdir():
            os.replace(path, folder / path.name)
    else:
        folder.parent.mkdir(parents=True, exist_ok=True)
        os.replace(new, folder)


def load_hub_folder(folder: str | os.PathLike[str]) -> tuple[Actor, RunConfig]:
    """Load what `write_hub_folder` wrote, wherever it was downloaded from; nothing is unpickled.

    No module is imported by its name, for a downloaded file may name any: import the one that
    registers the task before.

    Returns:
        The actor, which has SB3's `predict`, and the configuration that it was trained with, the
        module's name apart from the task's.

    Raises:
        ValueError: a file is missing or damaged, or the task is not registered here.
    """
    folder = Path(folder)
    try:
        config = RunConfig(**json.loads((folder / CONFIG).read_text(encoding="utf-8")))
        module, _, name = config.full_id.rpartition(":")
        config = replace(config, env_id=name, module=module or None)
    except (OSError, AttributeError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"{folder} holds no policy of this package ({error})") from error
    if module and name not in gym.registry:
        raise ValueError(f"{name!r} is registered by importing {module}: import it first")
    env = robot_vec_env(name, 1)
    try:
        space = env.observation_space
        actor, _ = load_actor(folder / POLICY, space, env.action_space)  # type: ignore[arg-type]
        return actor, config
    finally:
        env.close()


def check_new(folder: Path) -> None:
    """Raise a ValueError unless the folder is absent or empty, what a killed writer left apart."""
    if folder.exists() and not (folder.is_dir() and all(map(is_left_over, folder.iterdir()))):
        raise ValueError(f"{folder} is not empty; give another folder")


def _card(steps: int | None, command: str, config: RunConfig, results: dict[str, Any]) -> str:
    """Return the model card: metadata that the hub reads, and a text.

    Args:
        steps: env steps that the run took; None before its end.
        command: that started it; empty if unknown.
        config: of the run.
        results: of the test for the hub.
    """
    reward = f"{results['mean_reward']:.2f} +/- {results['std_reward']:.2f}"
    metrics = [
        {"type": "mean_reward", "value": reward, "name": "mean_reward", "verified": False},
        {"type": "success_rate", "value": results["success_rate"], "name": "success_rate"},
    ]
    task = {"type": "reinforcement-learning", "name": "reinforcement-learning"}
    dataset = {"name": config.env_id, "type": config.env_id}
    metadata = {
        "library_name": "stable-baselines3",
        "tags": [
            config.env_id,
            "deep-reinforcement-learning",
            "reinforcement-learning",
            "stable-baselines3",
            "sb3-follow-object",
        ],
        "model-index": [
            {
                "name": config.method,
                "results": [{"task": task, "dataset": dataset, "metrics": metrics}],
            }
        ],
    }
    text = _TEXT.format(
        method=config.method,
        env_id=config.env_id,
        imagined=_IMAGINED if config.settings.get("imagine", StageSettings.imagine) else "",
        success=results["success_rate"],
        episodes=results["n_eval_episodes"],
        env_steps="an unfinished training's" if steps is None else f"{steps:,}",
        command=_without_folders(command) or _described(config),
        config=CONFIG,
        versions=VERSIONS,
    )
    return f"---\n{yaml.safe_dump(metadata, sort_keys=False)}---\n{text}"


def _described(config: RunConfig) -> str:
    """Return a command that trains as a run did, settings apart."""
    words = ["sb3-follow-object", "train", "--env", config.full_id, "--method", config.method]
    words += ["--seed", str(config.seed), "--steps", str(config.total_timesteps)]
    return shlex.join(words)


def _without_folders(command: str) -> str:
    """Return a command without where its files lie: of their paths it keeps the last names.

    Empty where it is no line of a shell.
    """
    words: list[str] = []
    try:
        for word in shlex.split(command):
            option, equals, path = word.partition("=")
            if words and _names_a_path(words[-1]):
                word = Path(word).name or word
            elif equals and _names_a_path(option):
                word = f"{option}={Path(path).name or path}"
            words.append(word)
    except ValueError:
        return ""
    return " ".join(word if word == "&&" else shlex.quote(word) for word in words)


def _names_a_path(word: str) -> bool:
    """Whether a word is an option whose value is a path, written out or shortened."""
    return len(word) > 2 and any(option.startswith(word) for option in _PATHS)
