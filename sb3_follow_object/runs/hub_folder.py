"""A folder for the Hugging Face hub: model card, policy without pickle, configuration, results."""

from __future__ import annotations

import json
import os
from dataclasses import asdict
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import gymnasium as gym
import yaml
from stable_baselines3.td3.policies import Actor

from ..common.files import atomic_write
from ..ddpg.actor_files import load_actor
from ..envs.robot_copies import robot_vec_env
from ..settings.presets import load_config
from ..settings.run_config import CONFIG, RunConfig
from .evaluation import evaluate
from .run_folder import POLICY, RESULT, VERSIONS

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

_IMAGINED = ": in training it is shown goals on the way that the object would take by itself"


def write_hub_folder(run: str | os.PathLike[str], folder: str | os.PathLike[str]) -> None:
    """Write a folder that can be pushed to the Hugging Face hub as it is.

    It holds policy.safetensors, config.json, versions.json, results.json and a model card. The
    policy is tested for it as it was at the run's end, on the same episodes.

    Args:
        run: folder of a run; it need not be finished.
        folder: must be absent or empty.

    Raises:
        ValueError: the folder is not empty, or `run` holds no run that has a policy.
    """
    run, folder = Path(run), Path(folder)
    config = load_config(run)
    check_new(folder)
    n_episodes = config.n_final_episodes
    episodes = evaluate(run / POLICY, config.env_id, n_episodes, config.seed)
    results = {
        "env_id": config.env_id,
        "success_rate": episodes.success_rate,
        "mean_reward": float(episodes.returns.mean()),
        "std_reward": float(episodes.returns.std()),
        "is_deterministic": True,
        "n_eval_episodes": n_episodes,
        "eval_datetime": datetime.now(timezone.utc).isoformat(timespec="seconds"),
    }
    files = {
        POLICY: (run / POLICY).read_bytes(),
        CONFIG: json.dumps(asdict(config), indent=2).encode(),
        RESULTS: json.dumps(results, indent=2).encode(),
        CARD: _card(run, config, results).encode(),
    }
    if (run / VERSIONS).exists():
        files[VERSIONS] = (run / VERSIONS).read_bytes()
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        atomic_write(folder / name, content)


def load_hub_folder(folder: str | os.PathLike[str]) -> tuple[Actor, RunConfig]:
    """Load what `write_hub_folder` wrote, wherever it was downloaded from; nothing is unpickled.

    Returns:
        The actor, which has SB3's `predict`, and the configuration that it was trained with.

    Raises:
        ValueError: a file is missing or damaged, or the task is not registered here.
    """
    folder = Path(folder)
    try:
        config = RunConfig(**json.loads((folder / CONFIG).read_text(encoding="utf-8")))
    except (OSError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"{folder} holds no policy of this package ({error})") from error
    # The module is not imported by its name: a downloaded file may name any.
    if config.module is not None and config.env_id not in gym.registry:
        raise ValueError(
            f"{config.env_id!r} is registered by importing {config.module}: import it first"
        )
    env = robot_vec_env(config.env_id, 1)
    try:
        space = env.observation_space
        actor, _ = load_actor(folder / POLICY, space, env.action_space)  # type: ignore[arg-type]
        return actor, config
    finally:
        env.close()


def check_new(folder: Path) -> None:
    """Raise a ValueError unless the folder is absent or empty."""
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise ValueError(f"{folder} is not empty; give another folder")


def _card(run: Path, config: RunConfig, results: dict[str, Any]) -> str:
    """Return the model card: metadata that the hub reads, and a text."""
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
    made = json.loads((run / RESULT).read_text("utf-8")) if (run / RESULT).exists() else {}
    steps = made.get("env_steps")
    text = _TEXT.format(
        method=config.method,
        env_id=config.env_id,
        imagined=_IMAGINED if config.settings.get("imagine") else "",
        success=results["success_rate"],
        episodes=results["n_eval_episodes"],
        env_steps="an unfinished training's" if steps is None else f"{steps:,}",
        command=made.get("command") or f"sb3-follow-object train --env {config.full_id}",
        config=CONFIG,
        versions=VERSIONS,
    )
    return f"---\n{yaml.safe_dump(metadata, sort_keys=False)}---\n{text}"
