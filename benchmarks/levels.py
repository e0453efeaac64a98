"""How far a run's policy gets along the object's path: success on imagined goals, level by level.

    python benchmarks/levels.py benchmarks/results/PnPInsertion-fo-0 --levels 5 10 15 20 22 24

Prints a row a level: success on the imagined goal, and how far from the original goal the object
came to rest (medians, metres, level and vertical). Noise-free episodes of the run's policy, from a
stream of their own.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from sb3_follow_object import GoalPredictor
from sb3_follow_object.callbacks.rollout import run_episodes
from sb3_follow_object.common.seeds import stream_seed
from sb3_follow_object.ddpg.actor_files import load_actor
from sb3_follow_object.envs import make_vec
from sb3_follow_object.imagination.curriculum import Curriculum
from sb3_follow_object.imagination.vec_env import ImaginedGoalVecEnv
from sb3_follow_object.runs.object_stage_files import PREDICTOR
from sb3_follow_object.runs.run_folder import POLICY
from sb3_follow_object.settings.presets import load_config


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
    env = ImaginedGoalVecEnv(
        make_vec(config.env_id, arguments.episodes), predictor, curriculum, mode="test"
    )
    policy = arguments.run / POLICY
    actor, _ = load_actor(policy, env.observation_space, env.action_space)  # type: ignore[arg-type]
    env.seed(stream_seed(config.seed, "levels"))
    ends: list[np.ndarray] = []

    def note_ends(obs, actions, rewards, dones, infos, next_obs) -> None:  # type: ignore[no-untyped-def]
        goals = np.array([info["original_goal"] for info in infos])
        ends.extend((next_obs["achieved_goal"] - goals)[dones])

    print("level,success,level_distance,height")
    for level in arguments.levels:
        curriculum.k_max = level
        ends.clear()
        episodes = run_episodes(
            lambda obs: actor.predict(obs, deterministic=True)[0],
            env,
            arguments.episodes,
            note_ends,
        )
        across, above = np.median(np.hypot(*np.array(ends)[:, :2].T)), np.median(ends, axis=0)[2]
        print(f"{level},{episodes.success.mean():.2f},{across:.3f},{above:.3f}")
    env.close()


if __name__ == "__main__":
    main()
