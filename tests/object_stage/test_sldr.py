"""SLDR: the object's state in the robot's observation, its reward, and its networks' file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv
from tiny import TASK, cache_networks, cache_predictor, tiny_networks
from tiny_runs import bare_run
from toy import HORIZON, PointEnv

from sb3_follow_object.any_task.tasks import kept_as
from sb3_follow_object.callbacks.rollout import run_episodes
from sb3_follow_object.common.array_trees import load_tree, save_tree
from sb3_follow_object.common.files import LOCK, lock
from sb3_follow_object.ddpg.auxiliary import Transitions
from sb3_follow_object.ddpg.her_ddpg import HerDDPG
from sb3_follow_object.envs import (
    TASKS,
    FetchVecEnv,
    ObjectVecEnv,
    make_vec,
    object_state,
)
from sb3_follow_object.object_stage.networks import ACTION, FILE, OBSERVATION, ObjectNetworks
from sb3_follow_object.object_stage.sldr import SldrReward
from sb3_follow_object.runs import predictor_cache
from sb3_follow_object.runs.predictor_cache import (
    CACHE_VARIABLE,
    get_object_networks,
    get_predictor,
)

SMALL: dict[str, Any] = {"policy_kwargs": {"net_arch": [16]}, "batch_size": 16}
SMALL |= {"gradient_steps": 2, "buffer_size": 1000, "seed": 0}


# The mapping ----------------------------------------------------------------------------------


def place_object(simulation: Any, pose: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Put the object of a simulation's one copy somewhere and return the observation (1, d)."""
    data = simulation.data[0]
    qpos, qvel = simulation._object_qpos, simulation._object_qvel
    data.qpos[qpos : qpos + 7] = pose
    data.qvel[qvel : qvel + 6] = velocity
    mujoco.mj_forward(simulation.scene.model, data)
    simulation.refresh(0)
    return simulation.observe()[0]


@pytest.mark.parametrize("task", TASKS)
def test_robot_sees_the_object_as_the_object_env_does(task: str) -> None:
    robot = FetchVecEnv(f"FollowObject/{task}-v0", 1, 1, seed=0)
    alone = ObjectVecEnv(f"FollowObject/{task}Object-v0", 1, 1, seed=1)
    robot.reset(), alone.reset()
    rng = np.random.default_rng(0)
    for _ in range(5):
        robot.step(rng.uniform(-1, 1, (1, 4)).astype(np.float32))  # the gripper moves
        pose = np.concatenate([rng.uniform([1.0, 0.5, 0.5], [1.5, 1.0, 0.9]), rng.normal(size=4)])
        pose[3:] /= np.linalg.norm(pose[3:])
        velocity = rng.normal(size=6)
        of_robot = place_object(robot.simulation, pose, velocity)
        of_object = place_object(alone.simulation, pose, velocity)
        assert np.abs(of_robot[:, 20:23]).max() > 1e-4, "the gripper stands still"
        np.testing.assert_allclose(object_state(of_robot), of_object, atol=1e-9)
        as_tensor = object_state(th.from_numpy(of_robot))
        np.testing.assert_allclose(as_tensor.numpy(), of_object, atol=1e-9)
    robot.close(), alone.close()


def as_robot(state: np.ndarray) -> np.ndarray:
    """A robot's observations (n, 25) that hold object states (n, 12), with a moving gripper."""
    observation = np.random.default_rng(0).normal(size=(len(state), 25))
    observation[:, 3:6] = state[:, :3]
    observation[:, 11:14] = state[:, 3:6]
    observation[:, 14:17] = state[:, 6:9] - observation[:, 20:23]
    observation[:, 17:20] = state[:, 9:12]
    return observation.astype(np.float32)


# The reward -----------------------------------------------------------------------------------


class PointObject(PointEnv):
    """The toy's point with the spaces of an object's environment."""

    def __init__(self) -> None:
        super().__init__()
        box = spaces.Box(-np.inf, np.inf, (OBSERVATION,), np.float64)
        self.observation_space = spaces.Dict(
            {**self.observation_space.spaces, "observation": box}  # type: ignore[attr-defined]
        )
        self.action_space = spaces.Box(-1.0, 1.0, (ACTION,), np.float32)
        self.velocity = np.zeros(3)

    def reset(self, **options: Any) -> Any:
        self.velocity = np.zeros(3)
        return super().reset(**options)

    def step(self, action: np.ndarray) -> Any:
        before = self.position
        stepped = super().step(action[:3])
        self.velocity = self.position - before
        stepped[0]["observation"] = self._observe()["observation"]
        return stepped

    def _observe(self) -> dict[str, np.ndarray]:
        seen = super()._observe()
        state = np.zeros(OBSERVATION)
        state[:3], state[6:9] = self.position, self.velocity
        return {**seen, "observation": state}


@pytest.fixture(scope="module")
def trained() -> HerDDPG:
    """A toy object that has learned to reach its goals."""
    env = DummyVecEnv([PointObject] * 4)
    arch = {"net_arch": [64, 64]}
    model = HerDDPG(
        "MultiInputPolicy", env, policy_kwargs=arch, batch_size=64, gradient_steps=10,
        train_freq=HORIZON, gamma=0.9, seed=0,
    )  # fmt: skip
    return model.learn(6000, log_interval=None)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def networks(trained: HerDDPG) -> ObjectNetworks:
    return ObjectNetworks.learned(trained, "toy", "none", hidden=(64, 64), updates=1500)


def moved(trained: HerDDPG, how: str) -> dict[str, np.ndarray]:
    """Transitions of the toy object moved by its own policy, or otherwise from the same states."""
    env = DummyVecEnv([PointObject] * 4)
    env.seed(7)
    rng = np.random.default_rng(0)
    kept: list[tuple[np.ndarray, ...]] = []

    def keep(obs: Any, actions: Any, rewards: Any, dones: Any, infos: Any, next_obs: Any) -> None:
        state, after = obs["observation"], next_obs["observation"].copy()
        if how != "own":
            way = {"still": 0.0, "random": rng.uniform(-1, 1, (4, 3)), "back": -actions[:, :3]}[how]
            after[:, 6:9] = 0.05 * way
            after[:, :3] = state[:, :3] + after[:, 6:9]
        kept.append((state, after, obs["desired_goal"], actions))

    def policy(obs: Any) -> np.ndarray:
        return trained.predict(obs, deterministic=True)[0]

    assert run_episodes(policy, env, 40, keep).success_rate > 0.9
    columns = map(np.concatenate, zip(*kept, strict=True))
    return dict(zip(("state", "next_state", "goal", "action"), columns, strict=True))


def rewards(networks: ObjectNetworks, data: dict[str, np.ndarray]) -> np.ndarray:
    before, after = (
        {"observation": th.from_numpy(as_robot(data[key]))} for key in ("state", "next_state")
    )
    before["desired_goal"] = th.from_numpy(data["goal"].astype(np.float32))
    nothing = th.zeros(len(data["goal"]), 1)
    with th.no_grad():
        reward = SldrReward(1, networks)(Transitions(before, nothing, after, nothing, nothing))
    return reward.numpy()


def test_reward_is_near_zero_on_the_objects_own_paths_and_below_elsewhere(
    trained: HerDDPG, networks: ObjectNetworks
) -> None:
    own, *others = (
        rewards(networks, moved(trained, how)).mean() for how in ("own", "still", "random", "back")
    )
    assert own > -0.1
    assert max(others) < own - 0.2


def test_reward_lies_in_its_range(trained: HerDDPG, networks: ObjectNetworks) -> None:
    reward = rewards(networks, moved(trained, "random"))
    assert reward.shape[1] == 1
    assert reward.max() <= 0.0 and reward.min() >= -1.0
    assert SldrReward(1, networks).reward_range == (-1.0, 0.0)


def test_inverse_model_tells_the_actions_that_were_taken(
    trained: HerDDPG, networks: ObjectNetworks
) -> None:
    data = {k: th.from_numpy(v.astype(np.float32)) for k, v in moved(trained, "own").items()}
    with th.no_grad():
        inferred = networks.infer(data["state"], data["next_state"], data["goal"])
    # Only the first three move the toy.
    assert float((inferred - data["action"])[:, :3].abs().mean()) < 0.15
    assert networks.inverse_error < 0.4  # of the four that do not, their variance is left


def test_networks_are_those_of_the_trained_object(
    trained: HerDDPG, networks: ObjectNetworks
) -> None:
    data = trained.replay_buffer.sample(100)  # type: ignore[union-attr]
    z, goal = data.observations["observation"], data.observations["desired_goal"]
    with th.no_grad():
        assert th.equal(networks.act(z, goal), trained.actor(data.observations))
        q = trained.critic(data.observations, data.actions)[0]
        assert th.equal(networks.value(z, goal, data.actions), q)
    again = ObjectNetworks.learned(trained, "toy", "none", hidden=(8,), updates=1, seed=3)
    more = ObjectNetworks.learned(trained, "toy", "none", hidden=(8,), updates=1, seed=4)
    assert not th.equal(again.inverse[0].weight, more.inverse[0].weight)


@pytest.mark.parametrize("layer_norm", [False, True])
def test_every_shape_of_networks_can_be_copied_and_saved(layer_norm: bool, tmp_path: Path) -> None:
    kwargs = {"net_arch": {"pi": [8], "qf": [8, 4]}, "n_critics": 2}
    kwargs |= {"critic_layer_norm": layer_norm}
    env = DummyVecEnv([PointObject])
    model = HerDDPG(
        "MultiInputPolicy", env, policy_kwargs=kwargs, batch_size=8, gradient_steps=1,
        train_freq=HORIZON, gamma=0.9, seed=0,
    )  # fmt: skip
    model.learn(40, log_interval=None)  # type: ignore[arg-type]
    made = ObjectNetworks.learned(model, "toy", "none", hidden=(8,), updates=2, batch_size=4)
    made.save(tmp_path / "networks")
    loaded = ObjectNetworks.load(tmp_path / "networks", env_id="toy", physics="none")
    data = model.replay_buffer.sample(9)  # type: ignore[union-attr]
    z, goal = data.observations["observation"], data.observations["desired_goal"]
    with th.no_grad():
        wanted = th.stack(model.critic(data.observations, data.actions)).amin(dim=0)
        assert th.equal(loaded.value(z, goal, data.actions), wanted)
        assert th.equal(loaded.infer(z, z, goal), made.infer(z, z, goal))
    assert loaded.inverse_error == made.inverse_error


def test_making_networks_leaves_the_global_generator_alone() -> None:
    th.manual_seed(0)
    expected = th.rand(3)
    th.manual_seed(0)
    tiny_networks()
    assert th.equal(th.rand(3), expected)


# With SB3 alone -------------------------------------------------------------------------------


def robot(**auxiliary: Any) -> HerDDPG:
    env = make_vec(TASK, 2, 1, seed=0)
    return HerDDPG("MultiInputPolicy", env, auxiliary={"name": "sldr", **auxiliary}, **SMALL)


def test_robot_trains_with_networks_or_their_file(tmp_path: Path) -> None:
    made = tiny_networks()
    made.save(tmp_path / "networks")
    models = [robot(object_networks=given) for given in (made, tmp_path / "networks")]
    for model in models:
        model.learn(200, log_interval=None)  # type: ignore[arg-type]
    for a, b in zip(models[0].policy.parameters(), models[1].policy.parameters(), strict=True):
        assert th.equal(a, b)
    frozen = models[0].auxiliary_critic.reward.networks  # type: ignore[union-attr]
    for name, value in made.state_dict().items():
        assert th.equal(value, frozen.state_dict()[name])


def test_saved_robot_loads_where_the_networks_file_is_not(tmp_path: Path) -> None:
    tiny_networks().save(tmp_path / "networks")
    model = robot(object_networks=tmp_path / "networks")
    model.learn(100, log_interval=None)  # type: ignore[arg-type]
    model.save(tmp_path / "model")
    (tmp_path / "networks").unlink()
    loaded = HerDDPG.load(tmp_path / "model", env=model.env)
    loaded.learn(100, log_interval=None)  # type: ignore[arg-type]


def test_auto_takes_the_cached_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    cache_predictor(tmp_path)
    cache_networks(tmp_path)
    kept = get_object_networks(TASK, report=pytest.fail)
    used = robot().auxiliary_critic.reward.networks  # type: ignore[union-attr]
    assert th.equal(used.nu[0].weight, kept.nu[0].weight)


# What is refused ------------------------------------------------------------------------------


def test_other_environments_and_other_tasks_networks_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="needs a robot task of this package, not 'this one'"):
        HerDDPG(
            "MultiInputPolicy", DummyVecEnv([PointEnv]), auxiliary={"name": "sldr"},
            gamma=0.9, train_freq=10,
        )  # fmt: skip
    fetch = make_vec("FetchReach-v4", 1)
    with pytest.raises(ValueError, match="not 'FetchReach-v4'"):
        HerDDPG("MultiInputPolicy", fetch, auxiliary={"name": "sldr"})
    other = tiny_networks("FollowObject/PnPShelf-v0")
    with pytest.raises(ValueError, match="were made for env_id 'FollowObject/PnPShelf-v0'"):
        robot(object_networks=other)
    with pytest.raises(ValueError, match="there is no file"):
        robot(object_networks=tmp_path / "nothing")
    with pytest.raises(ValueError, match="can only be found for an environment"):
        SldrReward(1, "auto")


def test_run_needs_the_networks_of_its_object_stage() -> None:
    algorithm = {"auxiliary": {"name": "sldr"}}
    with pytest.raises(ValueError, match="were made for env_id"):
        bare_run(
            "FollowObject/PnPShelf-v0",
            object_networks=tiny_networks(),
            algorithm=algorithm,
            imagine=False,
        )
    with pytest.raises(ValueError, match="nothing of this method reads object_networks"):
        bare_run(TASK, object_networks=tiny_networks())
    with pytest.raises(ValueError, match="beside the predictor; give those of the same"):
        bare_run(TASK, object_networks=tiny_networks(), algorithm=algorithm)
    with pytest.raises(ValueError, match="give FollowObject object_networks instead"):
        bare_run(TASK, algorithm={"auxiliary": {"name": "sldr", "object_networks": "x"}})
    run = bare_run(TASK, algorithm=algorithm, imagine=False, n_envs=1)
    assert run.has_object_stage
    run.close()


def test_an_object_with_other_activations_is_refused_before_it_learns() -> None:
    of_object = {**SMALL, "policy_kwargs": {"net_arch": [8], "activation_fn": th.nn.Tanh}}
    del of_object["seed"]
    with pytest.warns(UserWarning, match="activation_fn"):
        run = bare_run(
            TASK,
            algorithm={"auxiliary": {"name": "sldr"}},
            object_algorithm=of_object,
            imagine=False,
            n_envs=1,
        )
    with pytest.raises(ValueError, match="reads an object policy with ReLU, not Tanh"):
        run.check()
    run.close()


def damage(tree: dict[str, Any], what: str) -> None:
    if what == "format":
        tree["format"] = 99
    elif what == "missing":
        del tree["tensors"]["nu.0.weight"]
    elif what == "nan":
        tree["tensors"]["nu.0.weight"][0, 0] = th.nan
    elif what == "wide":
        tree["shape"]["qf"] = [10**9]
    elif what == "deep":
        tree["shape"]["inverse"] = [8] * 1000
    elif what == "many":
        tree["shape"]["n_critics"] = 10**6
    elif what == "other":
        tree["shape"]["colour"] = 1


@pytest.mark.parametrize("what", ["format", "missing", "nan", "wide", "deep", "many", "other"])
def test_damaged_file_is_one_sentence(tmp_path: Path, what: str) -> None:
    tiny_networks().save(tmp_path / "networks")
    tree = load_tree(tmp_path / "networks")
    damage(tree, what)
    save_tree(tmp_path / "networks", tree)
    with pytest.raises(ValueError, match="does not hold an object's networks") as error:
        ObjectNetworks.load(tmp_path / "networks")
    assert "\n" not in str(error.value)


def test_half_a_file_and_bad_fits_are_refused(tmp_path: Path, trained: HerDDPG) -> None:
    tiny_networks().save(tmp_path / "networks")
    (tmp_path / "networks").write_bytes((tmp_path / "networks").read_bytes()[:-9])
    with pytest.raises(ValueError, match="not a whole checkpoint"):
        ObjectNetworks.load(tmp_path / "networks")
    for bad in ({"hidden": ()}, {"updates": 0}, {"learning_rate": 0.0}):
        with pytest.raises(ValueError, match=r"inverse_fit: (hidden|updates|learning_rate) "):
            ObjectNetworks.learned(trained, "toy", "none", **bad)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("keep", "get", "sentence"),
    [
        (cache_predictor, get_object_networks, "has predictor.json but no object_networks"),
        (cache_networks, get_predictor, "has object_networks.safetensors but no predictor.json"),
    ],
    ids=["F_phi alone", "networks alone"],
)
def test_half_an_object_stage_is_refused_and_left_alone(
    keep: Any, get: Any, sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(predictor_cache, "learn_predictor", lambda *_: pytest.fail("learned again"))
    keep(tmp_path)
    folder = tmp_path / TASK / kept_as(TASK)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(ValueError, match=f"{sentence}.*; give an empty folder"):
        get(TASK, folder, report=pytest.fail)
    after = {path.name: path.read_bytes() for path in folder.iterdir() if path.name != LOCK}
    assert after == before


def test_half_an_object_stage_in_the_cache_is_learned_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    cache_predictor(tmp_path)
    learned: list[Path] = []

    def learn(config: Any, folder: Path, report: Any) -> None:
        with pytest.raises(ValueError, match="another process"), lock(folder, wait=False):
            pass
        tiny_networks().save(folder / FILE)
        learned.append(folder)

    monkeypatch.setattr(predictor_cache, "learn_predictor", learn)
    for _ in range(2):
        assert get_object_networks(TASK, report=pytest.fail).env_id == TASK
    assert learned == [tmp_path / TASK / kept_as(TASK)]


def test_networks_name_their_task_without_a_module(tmp_path: Path) -> None:
    path = tmp_path / "networks"
    made = ObjectNetworks(f"a.module:{TASK}", "b", pi=[8], qf=[8], inverse=[8])
    assert made.env_id == TASK
    made.save(path)
    saved = load_tree(path)
    assert saved["env_id"] == TASK
    save_tree(path, {**saved, "env_id": f"a.module:{TASK}"})  # as files of before have it
    for wanted in (TASK, f"a.module:{TASK}"):
        assert ObjectNetworks.load(path, env_id=wanted).env_id == TASK
    with pytest.raises(ValueError, match=f"made for env_id '{TASK}', not for 'Other-v0'"):
        ObjectNetworks.load(path, env_id="a.module:Other-v0")


def test_networks_of_other_physics_are_refused(tmp_path: Path) -> None:
    tiny_networks().save(tmp_path / "networks")
    with pytest.raises(ValueError, match="were made for physics"):
        ObjectNetworks.load(tmp_path / "networks", physics="another")
