"""The paper's cross test: a policy that was trained on one task, tested on another."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from ..common.files import atomic_write
from ..common.reports import Report
from ..envs.goal_envs import check_task
from ..runs.evaluation import evaluate
from ..runs.run_folder import CROSS_TESTS, POLICY, task_label
from ..settings.presets import load_config
from ..settings.run_config import RunConfig

# Section 5.3: one task with two samplers of starts and goals; HER-a is trained on the first,
# HER-b on the second, and each is tested on both.
PAIR = ("PnPSimpleV1", "PnPSimpleV2")


def cross_test(
    run: str | os.PathLike[str],
    env_id: str,
    n_episodes: int | None = None,
    seed: int | None = None,
    report: Report | None = None,
) -> float:
    """Test a run's policy on another task, keep the figure in the run's folder and return it.

    Kept is the test with the most episodes, of equal ones the last.

    Args:
        run: folder with config.json and policy.safetensors.
        env_id: the other task; its observations, actions and goals must be shaped as the run's.
        n_episodes: >= 1; by default as many as the run's own final test.
        seed: of the episodes; by default the run's.
        report: called with a sentence where the figure cannot be kept; None raises.

    Raises:
        OSError: the figure cannot be kept, and nobody is told by `report`.
        ValueError: there is no such task, no policy, or it does not fit.
    """
    check_task(env_id)
    run = Path(run)
    config = load_config(run)
    n_episodes = config.n_final_episodes if n_episodes is None else n_episodes
    seed = config.seed if seed is None else seed
    rate = evaluate(run / POLICY, env_id, n_episodes, seed).success_rate
    kept, name = read_cross_tests(run), task_label(env_id)
    if name not in kept or kept[name]["episodes"] <= n_episodes:
        kept[name] = {"success_rate": rate, "episodes": n_episodes}
        try:
            atomic_write(run / CROSS_TESTS, json.dumps(kept, indent=1).encode())
        except OSError as error:
            if report is None:
                raise
            report(f"the figure is not kept in {run}: {error.strerror}")
    return rate


def read_cross_tests(run: str | os.PathLike[str]) -> dict[str, dict[str, Any]]:
    """Return a run's cross tests by the other task's name.

    Raises:
        ValueError: the file is damaged.
    """
    path = Path(run) / CROSS_TESTS
    if not path.exists():
        return {}
    try:
        content = json.loads(path.read_text("utf-8"))
        return {
            str(task): {
                "success_rate": float(figures["success_rate"]),
                "episodes": int(figures["episodes"]),
            }
            for task, figures in content.items()
        }
    except (OSError, AttributeError, KeyError, RecursionError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is not a file of cross tests ({error})") from error


def partner(task: str) -> str | None:
    """Return the task that policies of this one are tested on too; None for most."""
    return dict([PAIR, PAIR[::-1]]).get(task)


def cross_name(run: str, task: str) -> str:
    """Return the name of a run's cross test.

    Args:
        run: name of its folder.
        task: that it was trained on.
    """
    return f"{run} on {partner(task)}"


def needs_cross_test(run: Path, config: RunConfig) -> bool:
    """Whether a run's policy is to be tested on another task, or on more episodes than it was.

    Raises:
        ValueError: the file of its cross tests is damaged.
    """
    other = partner(task_label(config.env_id))
    if other is None:
        return False
    kept = read_cross_tests(run).get(other)
    return kept is None or kept["episodes"] < config.n_final_episodes
