"""How far a run's policy gets along the object's path: success on imagined goals, level by level.

    python benchmarks/levels.py benchmarks/results/PnPInsertion-fo-0 --levels 5 10 15 20 22 24

Prints a row a level, the original goals last: success on the goal that was shown, and how far from
the original goal the object came to rest (medians, metres, level and vertical). Original goals give
the starts; noise-free episodes of the policy that the run kept, from a stream of their own.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from sb3_follow_object import GoalPredictor
from sb3_follow_object.config import load_config
from sb3_follow_object.curriculum import Curriculum
from sb3_follow_object.envs import make_vec
from sb3_follow_object.experiment import POLICY
from sb3_follow_object.imagination import imagine
from sb3_follow_object.policies import load_actor
from sb3_follow_object.run_folder import PREDICTOR
from sb3_follow_object.seeds import stream_seed

REACHED = 0.05  # metres


def main() -> None:
    """Test the policy level by level."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, help="run folder of fo or fo-sldr")
    parser.add_argument("--levels", type=int, nargs="+", required=True)
    parser.add_argument("--episodes", type=int, default=100, help="of each level; default: 100")
    arguments = parser.parse_args()
    config = load_config(arguments.run)
    predictor = GoalPredictor.load(arguments.run / PREDICTOR, config.env_id)
    curriculum = Curriculum(predictor.horizon, **config.settings["curriculum"])
    env = make_vec(config.env_id, arguments.episodes)
    policy = arguments.run / POLICY
    actor, _ = load_actor(policy, env.observation_space, env.action_space)  # type: ignore[arg-type]
    env.seed(stream_seed(config.seed, "levels"))
    print("level,success,level_distance,height")
    for level in [*arguments.levels, None]:
        obs = env.reset()
        goal = obs["desired_goal"].copy()
        shown = goal
        if level is not None:
            levels = np.full(len(goal), level)
            shown = imagine(predictor, curriculum, obs["achieved_goal"], goal, levels)
        dones = np.zeros(len(goal), dtype=bool)
        while not dones.any():  # all end together, with the last observation in their infos
            actions, _ = actor.predict({**obs, "desired_goal": shown}, deterministic=True)
            obs, _, dones, infos = env.step(actions)
        end = np.array([info["terminal_observation"]["achieved_goal"] for info in infos])
        success = np.mean(np.linalg.norm(end - shown, axis=1) < REACHED)
        across = np.median(np.hypot(*(end - goal)[:, :2].T))
        above = np.median((end - goal)[:, 2])
        print(f"{'goal' if level is None else level},{success:.2f},{across:.3f},{above:.3f}")
    env.close()


if __name__ == "__main__":
    main()
