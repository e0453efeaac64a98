"""Gymnasium's helpers, recorders and wrappers work on these environments as on its own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer
from gymnasium.envs.mujoco.utils import check_mujoco_reset_state, get_state
from gymnasium.utils.env_match import check_environments_match
from gymnasium.utils.save_video import save_video

import sb3_follow_object  # noqa: F401  registers the ids
from sb3_follow_object.envs import IDS, make_vec

TASK = "FollowObject/PnPShelf-v0"
STATE = mujoco.mjtState.mjSTATE_INTEGRATION
every_id = pytest.mark.parametrize("env_id", IDS)


@every_id
def test_mujoco_reset_state_is_that_of_the_seed(env_id: str) -> None:
    env = gym.make(env_id)
    check_mujoco_reset_state(env)
    unwrapped: Any = env.unwrapped
    assert unwrapped.data.time == unwrapped.simulation.scene.time
    env.step(env.action_space.sample())
    assert unwrapped.data.time == pytest.approx(unwrapped.simulation.scene.time + unwrapped.dt)
    assert unwrapped.model.body("object0").mass > 0
    env.close()


@every_id
def test_a_step_is_the_same_whether_or_not_its_data_is_looked_at(env_id: str) -> None:
    plain, watched = gym.make(env_id).unwrapped, gym.make(env_id).unwrapped
    plain.reset(seed=2)
    watched.reset(seed=2)
    rng = np.random.default_rng(0)
    for action in rng.uniform(-1, 1, (12, *plain.action_space.shape)):  # type: ignore[misc]
        get_state(watched, STATE)  # type: ignore[arg-type]
        first, second = plain.step(action)[0], watched.step(action)[0]
        for key, value in first.items():
            np.testing.assert_array_equal(value, second[key])


@every_id
def test_what_is_written_into_the_data_counts_from_the_next_step_on(env_id: str) -> None:
    env: Any = gym.make(env_id).unwrapped
    env.reset(seed=2)
    actions = np.random.default_rng(0).uniform(-1, 1, (20, *env.action_space.shape))
    for action in actions[:10]:
        env.step(action)
    state = get_state(env, STATE)
    expected = env.step(actions[10])[0]["observation"][:3]  # where the gripper, or the object, is
    for action in actions[11:]:
        env.step(action)
    assert np.abs(env.step(actions[10])[0]["observation"][:3] - expected).max() > 0.02
    mujoco.mj_setState(env.model, env.data, state, STATE)
    # The pose that the action counts from was one substep behind, so the bits are not the same.
    again = env.step(actions[10])[0]["observation"][:3]
    np.testing.assert_allclose(again, expected, atol=2e-3)


def test_a_batch_tells_the_data_of_each_copy() -> None:
    venv = make_vec(TASK, 3, 1, seed=0)
    venv.reset()
    assert venv.get_attr("data", [2, 0]) == [venv.simulation.data[i] for i in (2, 0)]
    assert venv.get_attr("model") == [venv.simulation.scene.model] * 3
    assert venv.get_attr("dt") == [0.04] * 3
    venv.close()


@pytest.mark.usefixtures("can_draw")
def test_two_of_an_id_match_in_pictures_too() -> None:
    first, second = (gym.make(TASK, render_mode="rgb_array") for _ in range(2))
    check_environments_match(first, second, num_steps=3)
    first.close()
    second.close()


@pytest.mark.usefixtures("can_draw")
@pytest.mark.parametrize("env_id", [TASK, "FollowObject/PnPInsertionObject-v0"])
def test_recorders_record(env_id: str, tmp_path: Path) -> None:
    env = gym.make(env_id, render_mode="rgb_array", max_episode_steps=4)
    env = wrappers.RecordVideo(env, str(tmp_path / "films"), disable_logger=True)
    env = wrappers.RecordEpisodeStatistics(env)
    env.reset(seed=0)
    over = False
    while not over:
        *_, over, info = env.step(env.action_space.sample())
    assert info["episode"]["l"] == 4
    env.close()
    (video,) = tmp_path.glob("films/*.mp4")
    assert video.read_bytes()[4:8] == b"ftyp"


@pytest.mark.usefixtures("can_draw")
def test_frames_are_saved_and_observed(tmp_path: Path) -> None:
    frames = gym.make(TASK, render_mode="rgb_array")
    seen = wrappers.AddRenderObservation(frames, render_only=False, render_key="picture")
    obs, _ = seen.reset(seed=0)
    assert obs["picture"].shape == (480, 480, 3)
    assert obs in seen.observation_space
    save_video(
        [frames.render()] * 3, str(tmp_path / "films"), fps=25, episode_trigger=lambda _: True
    )
    assert list(tmp_path.glob("films/*.mp4"))
    seen.close()


@pytest.mark.usefixtures("can_draw")
def test_gymnasiums_renderer_draws_the_physics() -> None:
    env: Any = gym.make(TASK).unwrapped
    env.reset(seed=0)
    renderer = MujocoRenderer(env.model, env.data, width=64, height=48)
    picture = renderer.render("rgb_array")
    assert picture.shape == (48, 64, 3) and picture.std() > 1
    renderer.close()
    env.close()


def test_observations_are_transformed() -> None:
    env = gym.make(TASK)
    halved = wrappers.TransformObservation(
        env, lambda obs: {key: 0.5 * value for key, value in obs.items()}, env.observation_space
    )
    whole, half = env.reset(seed=0)[0], halved.reset(seed=0)[0]
    np.testing.assert_array_equal(half["observation"], 0.5 * whole["observation"])


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_gymnasiums_vectors_step_it(mode: Any) -> None:
    envs = gym.make_vec(TASK, num_envs=2, vectorization_mode=mode, max_episode_steps=3)
    single = gym.make(TASK)
    obs, _ = envs.reset(seed=[4, 5])
    expected, _ = single.reset(seed=5)
    for step in range(3):
        for key, value in expected.items():
            np.testing.assert_array_equal(obs[key][1], value)
        actions = np.full((2, 4), 0.5, np.float32)
        obs, _, _, truncated, infos = envs.step(actions)
        expected, *_, info = single.step(actions[1])
        assert truncated.all() == (step == 2)
        assert infos["is_success"][1] == info["is_success"]
    envs.close()


# Episodes of another length


@every_id
def test_episodes_are_as_long_as_they_are_asked_for(env_id: str) -> None:
    horizon = IDS[env_id][0].horizon + 7
    env, venv = (
        gym.make(env_id, max_episode_steps=horizon),
        make_vec(env_id, 2, 1, seed=3, max_episode_steps=horizon),
    )
    assert env.spec is not None and env.spec.max_episode_steps == horizon
    assert [spec.max_episode_steps for spec in venv.get_attr("spec")] == [horizon] * 2
    assert gym.spec(env_id).max_episode_steps == horizon - 7, "the id's own is as it was"
    venv.reset()
    obs, _ = env.reset(seed=4)
    for step in range(horizon):
        action = np.full(env.action_space.shape, 0.1, np.float32)  # type: ignore[arg-type]
        _, _, dones, infos = venv.step(np.stack([action, action]))
        obs, *_, truncated, _ = env.step(action)
        assert truncated == dones.all() == dones.any() == (step == horizon - 1)
    for key, value in obs.items():
        np.testing.assert_array_equal(infos[1]["terminal_observation"][key], value)
    venv.close()


@pytest.mark.parametrize(
    ("env_id", "options", "sentence"),
    [
        (TASK, {"max_episode_steps": -1}, "max_episode_steps is -1; it must be at least 1"),
        (TASK, {"max_episode_steps": 2.5}, "max_episode_steps must be a whole number, not 2.5"),
        (TASK, {"seed": -1}, "seed is -1; it must be at least 0"),
        ("CartPole-v1", {"seed": "a"}, "seed must be a whole number, not 'a'"),
        ("Hopper-v1", {}, "'Hopper-v1' cannot be made: .* deprecated"),
    ],
)
def test_a_batch_that_cannot_be_meant_is_refused(
    env_id: str, options: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(ValueError, match=sentence):
        make_vec(env_id, 2, 1, **options)


@pytest.mark.parametrize("env_id", [TASK, TASK.replace("-v0", "Object-v0")])
def test_no_step_before_the_first_reset(env_id: str) -> None:
    venv = make_vec(env_id, 2, 1)
    with pytest.raises(ValueError, match=r"no episode has begun: call reset\(\) first"):
        venv.step(np.zeros((2, *venv.action_space.shape)))
    venv.reset()
    venv.step(np.zeros((2, *venv.action_space.shape)))
    venv.close()


def test_other_environments_take_the_length_too() -> None:
    venv = make_vec("CartPole-v1", 1, max_episode_steps=9)
    assert venv.get_attr("spec")[0].max_episode_steps == 9
    venv.close()
