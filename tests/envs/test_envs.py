"""The environments as their users meet them: gymnasium's and SB3's protocols, over every id."""

import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_sb3

import sb3_follow_object  # noqa: F401  registers the ids
from sb3_follow_object.envs import (
    IDS,
    TASKS,
    FetchEnv,
    FetchVecEnv,
    ObjectVecEnv,
    make_vec,
    physics_id,
    register_envs,
)
from sb3_follow_object.envs.scene import fetch_scene
from sb3_follow_object.envs.tasks import MIN_START_DISTANCE, reference_point

every_id = pytest.mark.parametrize("env_id", IDS)


def actions_for(space: gym.spaces.Box, *shape: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.uniform(-1, 1, (*shape, *space.shape)).astype(np.float32)


def assert_equal(first: dict[str, np.ndarray], second: dict[str, np.ndarray]) -> None:
    for key in ("observation", "achieved_goal", "desired_goal"):
        np.testing.assert_array_equal(first[key], second[key], err_msg=key)


@every_id
def test_gymnasium_and_sb3_accept_it(env_id: str) -> None:
    env = gym.make(env_id)
    assert env.spec is not None
    assert env.spec.max_episode_steps == IDS[env_id][0].horizon
    check_env(env.unwrapped, skip_render_check=True)
    check_env_sb3(env.unwrapped)
    env.close()


@every_id
def test_same_seed_same_episode_and_nothing_shared(env_id: str) -> None:
    first, second = gym.make(env_id).unwrapped, gym.make(env_id).unwrapped
    previous, _ = first.reset(seed=3)
    assert_equal(previous, second.reset(seed=3)[0])
    for action in actions_for(first.action_space, 10):
        kept = {key: value.copy() for key, value in previous.items()}
        obs, reward, terminated, truncated, info = first.step(action)
        other = second.step(action)
        assert_equal(obs, other[0])
        assert (reward, terminated, truncated, info) == other[1:]
        assert all(np.isfinite(value).all() for value in obs.values())
        assert_equal(previous, kept)
        assert not any(np.shares_memory(obs[key], previous[key]) for key in obs)
        previous = obs


@every_id
def test_a_pickled_copy_goes_on_alike(env_id: str) -> None:
    env = gym.make(env_id).unwrapped
    env.reset(seed=5)
    actions = actions_for(env.action_space, 8)
    for action in actions[:4]:
        env.step(action)
    twin = pickle.loads(pickle.dumps(env))
    for action in actions[4:]:
        assert_equal(env.step(action)[0], twin.step(action)[0])
    assert_equal(env.reset()[0], twin.reset()[0])


@every_id
def test_starts_and_goals_lie_in_the_regions_of_the_task(env_id: str) -> None:
    task, _ = IDS[env_id]
    marks = fetch_scene(task).landmarks
    env = gym.make(env_id).unwrapped
    heights = []
    for seed in range(60):
        obs, _ = env.reset(seed=seed)
        for region, point in ((task.start, "achieved_goal"), (task.goal, "desired_goal")):
            offset = obs[point][:2] - reference_point(region, marks)
            # reset() does not step, so the object is where it was drawn
            assert (offset >= np.array(region.low) - 1e-6).all(), (seed, point)
            assert (offset <= np.array(region.high) + 1e-6).all(), (seed, point)
        start = obs["achieved_goal"][:2]
        reference = reference_point(task.start, marks)
        assert np.linalg.norm(start - reference) >= MIN_START_DISTANCE - 1e-6
        apart = np.linalg.norm(start - obs["desired_goal"][:2])
        assert apart >= task.min_goal_distance - 1e-6
        heights.append(obs["desired_goal"][2] - marks.rest_height)
    law = task.height
    on_table = np.isclose(heights, 0.0)
    above = np.array(heights)[~on_table]
    assert ((above >= law.low) & (above <= law.high + 1e-9)).all()
    expected = law.chance if law.high > 0 else 0.0
    assert abs((~on_table).mean() - expected) < 0.25


@every_id
@pytest.mark.parametrize("n_threads", [1, 2])
def test_every_copy_of_a_batch_is_the_single_environment(env_id: str, n_threads: int) -> None:
    n_envs, horizon = 3, IDS[env_id][0].horizon
    venv = make_vec(env_id, n_envs, n_threads, seed=11)
    envs = [gym.make(env_id) for _ in range(n_envs)]
    batch = venv.reset()
    for index, env in enumerate(envs):
        assert_equal(
            {key: value[index] for key, value in batch.items()}, env.reset(seed=11 + index)[0]
        )
    # the last steps are those of a second episode, which resets itself in the batch
    for step, actions in enumerate(actions_for(venv.action_space, horizon + 3, n_envs)):
        batch, rewards, dones, infos = venv.step(actions)
        assert dones.all() == dones.any() == (step == horizon - 1)
        for index, env in enumerate(envs):
            obs, reward, _, truncated, info = env.step(actions[index])
            assert rewards[index] == np.float32(reward)
            assert infos[index]["is_success"] == info["is_success"]
            assert infos[index]["TimeLimit.truncated"] == truncated == dones[index]
            if truncated:
                assert_equal(infos[index]["terminal_observation"], obs)
                obs, _ = env.reset()
            assert_equal({key: value[index] for key, value in batch.items()}, obs)
    venv.close()


@every_id
@pytest.mark.parametrize("reward_type", ["sparse", "dense"])
def test_compute_reward_of_many_equals_the_rewards_of_steps(env_id: str, reward_type: str) -> None:
    env = gym.make(env_id, reward_type=reward_type).unwrapped
    env.reset(seed=1)
    achieved, desired, rewards, successes = [], [], [], []
    for action in actions_for(env.action_space, 6):
        obs, reward, _, _, info = env.step(action)
        achieved.append(obs["achieved_goal"])
        desired.append(obs["desired_goal"])
        rewards.append(reward)
        successes.append(info["is_success"])
    many = env.compute_reward(np.array(achieved), np.array(desired), {})
    assert many.shape == (6,)
    np.testing.assert_array_equal(many, rewards)
    np.testing.assert_array_equal(env.is_success(np.array(achieved), np.array(desired)), successes)


def test_reward_and_success_agree_at_the_threshold() -> None:
    env = FetchEnv("PnPSimpleV1")
    goals = np.zeros((3, 3))
    achieved = np.array([[0.0, 0.0, 0.0], [0.05, 0.0, 0.0], [0.0501, 0.0, 0.0]])
    assert env.is_success(achieved, goals).tolist() == [True, True, False]
    assert env.compute_reward(achieved, goals, {}).tolist() == [0.0, 0.0, -1.0]


@pytest.mark.parametrize(
    "env_id", ["FollowObject/PnPInsertion-v0", "FollowObject/PushSideGapObject-v0"]
)
def test_a_resumed_batch_goes_on_bit_for_bit(env_id: str) -> None:
    horizon = IDS[env_id][0].horizon
    venv = make_vec(env_id, 2, 1, seed=0)
    venv.reset()
    actions = actions_for(venv.action_space, horizon + 5, 2)
    for action in actions[:20]:
        venv.step(action)
    resumed = make_vec(env_id, 2, 2, seed=99)
    resumed.set_state(pickle.loads(pickle.dumps(venv.get_state())))
    for action in actions[20:]:
        first, second = venv.step(action), resumed.step(action)
        assert_equal(first[0], second[0])
        np.testing.assert_array_equal(first[2], second[2])
    with pytest.raises(ValueError, match="3 environments"):
        make_vec(env_id, 3, 1).set_state(venv.get_state())


def test_vec_env_calls_reach_what_all_copies_share() -> None:
    venv = FetchVecEnv("FollowObject/PnPShelf-v0", 3, 1)
    assert venv.get_attr("reward_type") == ["sparse"] * 3
    goals = np.zeros((4, 3))
    (rewards,) = venv.env_method("compute_reward", goals, goals, [{}] * 4, indices=[0])
    assert rewards.tolist() == [0.0] * 4
    assert venv.env_is_wrapped(gym.Wrapper) == [False] * 3


def test_make_vec_serves_other_environments_too() -> None:
    venv = make_vec("CartPole-v1", 2, seed=0)
    assert venv.reset().shape == (2, 4)
    venv.close()


def test_physics_id_is_shared_with_the_object_alone_and_with_no_other_task() -> None:
    ids = {name: physics_id(f"FollowObject/{name}-v0") for name in TASKS}
    assert len(set(ids.values())) == len(TASKS)
    assert ids["PnPShelf"] == physics_id("FollowObject/PnPShelfObject-v0")


def test_registering_again_changes_nothing() -> None:
    before = dict(gym.registry)
    register_envs()
    assert dict(gym.registry) == before


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: make_vec("FollowObject/PnPShelv-v0", 1),
            "did you mean 'FollowObject/PnPShelf-v0'",
        ),
        (lambda: FetchEnv("PnPShelv"), "did you mean 'PnPShelf'"),
        (lambda: FetchVecEnv("FollowObject/PnPShelfObject-v0", 1), "'FollowObject/PnPShelf-v0'"),
        (lambda: ObjectVecEnv("FollowObject/PnPShelf-v0", 1), "'FollowObject/PnPShelfObject-v0'"),
        (lambda: FetchVecEnv("FollowObject/PnPShelf-v0", 0), "n_envs is 0; it must be at least 1"),
        (lambda: make_vec("CartPole-v1", 0), "n_envs is 0; it must be at least 1"),
        (
            lambda: FetchVecEnv("FollowObject/PnPShelf-v0", 1, 0),
            "n_threads is 0; it must be",
        ),
        (lambda: FetchEnv("PnPShelf", reward_type="shaped"), "'sparse' or 'dense'"),
        (lambda: FetchEnv("PnPShelf", render_mode="ansi"), "'rgb_array' or 'human'"),
        (lambda: FetchEnv("PnPShelf", collision="none"), "'reachable' or 'full'"),
        (lambda: FetchEnv("PnPShelf").set_markers(np.zeros(3)), r"shape \(n, 3\)"),
        (lambda: FetchEnv("PnPShelf").step(np.zeros(7)), r"shape \(7,\)"),
        (lambda: physics_id("CartPole-v1"), "Unknown environment id"),
    ],
)
def test_user_errors_are_sentences(make, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_actions_must_be_finite() -> None:
    venv = FetchVecEnv("FollowObject/PnPSimpleV1-v0", 2, 1)
    venv.reset()
    actions = np.zeros((2, 4))
    actions[1, 0] = np.nan
    with pytest.raises(ValueError, match=r"action of environment 1 is .*must be finite"):
        venv.step(actions)


@pytest.mark.usefixtures("can_draw")
@pytest.mark.parametrize(
    "env_id", ["FollowObject/PnPInsertion-v0", "FollowObject/PnPShelfObject-v0"]
)
def test_pictures_show_markers_and_regions(env_id: str) -> None:
    plain = gym.make(env_id, render_mode="rgb_array").unwrapped
    marked = gym.make(env_id, render_mode="rgb_array", show_regions=True).unwrapped
    plain.reset(seed=0)
    marked.reset(seed=0)
    first = plain.render()
    assert first.shape == (480, 480, 3) and first.dtype == np.uint8 and first.std() > 10
    second = marked.render()
    assert (first != second).any()
    marked.set_markers(np.array([[1.3, 0.6, 0.6]]))
    assert (second != marked.render()).any()
    plain.close()
    marked.close()
    venv = make_vec(env_id, 2, 1, render_mode="rgb_array")
    venv.reset()
    assert venv.render().shape == (960, 480, 3)
    venv.close()


def test_a_second_reset_starts_other_episodes() -> None:
    venv = FetchVecEnv("FollowObject/PnPSimpleV1-v0", 2, 1, seed=3)
    first, second = venv.reset()["desired_goal"], venv.reset()["desired_goal"]
    assert (first != second).any(axis=1).all()
    venv.seed(3)
    np.testing.assert_array_equal(venv.reset()["desired_goal"], first)


def test_a_pickled_copy_keeps_its_seed_reward_and_spec() -> None:
    env = gym.make("FollowObject/PnPShelf-v0").unwrapped
    env.reset(seed=5)
    env.reward_type = "dense"
    twin = pickle.loads(pickle.dumps(env))
    assert (twin.np_random_seed, twin.reward_type, twin.spec) == (5, "dense", env.spec)
    np.testing.assert_array_equal(
        twin.reset()[0]["desired_goal"], env.reset()[0]["desired_goal"], err_msg="next goal"
    )


def test_a_state_of_another_task_is_refused() -> None:
    one, other = (make_vec(f"FollowObject/{n}-v0", 1, 1) for n in ("PushSideGap", "PushMiddleGap"))
    one.reset()
    with pytest.raises(ValueError, match="not of PushMiddleGap but of"):
        other.set_state(one.get_state())


def test_copies_of_a_batch_share_their_attributes_and_can_be_made_again() -> None:
    venv = make_vec("FollowObject/PnPShelf-v0", 2, 1)
    with pytest.raises(ValueError, match="all copies share 'reward_type'"):
        venv.set_attr("reward_type", "dense", indices=[0])
    venv.set_attr("reward_type", "dense")
    assert venv.get_attr("reward_type") == ["dense", "dense"]
    assert venv.metadata["render_fps"] == 25
    assert gym.make(venv.get_attr("spec")[0]).spec.id == "FollowObject/PnPShelf-v0"


def test_wrong_options_and_modules_are_refused_in_a_sentence() -> None:
    with pytest.raises(ValueError, match=r"cannot be made: .*colour"):
        make_vec("FollowObject/PnPShelf-v0", 1, colour="red")
    with pytest.raises(ValueError, match="names a module that cannot be imported"):
        make_vec("no_such_module:FollowObject/Other-v0", 1)
