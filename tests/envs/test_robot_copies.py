"""Copies in processes do what copies in one process do, to the bit."""

from __future__ import annotations

import pickle
from typing import Any

import arm_and_wall
import numpy as np
import pytest
import toy
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_follow_object.envs.robot_copies import ProcessVecEnv, robot_maker, robot_vec_env


def test_processes_say_nothing_of_other_environments_versions(
    capfd: pytest.CaptureFixture[str],
) -> None:
    ProcessVecEnv(robot_maker("FetchReach-v4"), 1, 1).close()
    assert capfd.readouterr() == ("", "")


class Breaks(toy.PointEnv):
    def step(self, action: np.ndarray) -> Any:
        if self.steps == 2:
            raise ZeroDivisionError("the gripper left the table")
        return super().step(action)


def test_results_do_not_depend_on_the_number_of_processes() -> None:
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1.0, 1.0, (55, 5, 3)).astype(np.float32)
    outcomes = []
    for n_threads in (1, 2):
        env = robot_vec_env(arm_and_wall.ARM, 5, n_threads)
        assert isinstance(env, DummyVecEnv if n_threads == 1 else ProcessVecEnv)
        env.seed(7)
        seen = [env.reset()]
        ends = []
        for action in actions:
            obs, rewards, dones, infos = env.step(action)
            seen.append({key: values.copy() for key, values in obs.items()})
            ends.append((rewards.copy(), dones.copy(), infos))
        goal = seen[-1]["desired_goal"]
        assert env.env_method("compute_reward", goal, goal, None, indices=[0])[0].shape == (5,)
        assert env.get_attr("spec", indices=[0])[0].max_episode_steps == 50
        assert env.has_attr("compute_reward") and not env.has_attr("no such thing")
        outcomes.append((seen, ends))
        env.close()
    (seen, ends), (other_seen, other_ends) = outcomes
    for one, other in zip(seen, other_seen, strict=True):
        for key, values in one.items():
            assert values.dtype == other[key].dtype
            np.testing.assert_array_equal(values, other[key])
    for one, other in zip(ends, other_ends, strict=True):
        np.testing.assert_array_equal(one[0], other[0])
        np.testing.assert_array_equal(one[1], other[1])
        for info, other_info in zip(one[2], other[2], strict=True):
            assert info["TimeLimit.truncated"] == other_info["TimeLimit.truncated"]
            last, other_last = (i.get("terminal_observation") for i in (info, other_info))
            assert (last is None) == (other_last is None)
            if last is not None:
                np.testing.assert_array_equal(last["observation"], other_last["observation"])
    assert ends[49][1].all() and not ends[48][1].any()


def test_what_goes_wrong_in_a_process_is_raised_here() -> None:
    env = ProcessVecEnv(Breaks, 2, 2)
    env.reset()
    with pytest.raises(ZeroDivisionError, match="the gripper left the table"):
        for _ in range(3):
            env.step(np.zeros((2, 3)))
    with pytest.raises(ValueError, match="in processes cannot be copied"):
        pickle.dumps(env)
    env.close()
    env.close()
