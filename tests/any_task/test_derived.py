"""An object's own environment, made of a task that nobody here wrote."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import arm_and_wall
import gymnasium as gym
import mujoco
import numpy as np
import pytest
from test_finding import Kitchen

from sb3_follow_object.any_task import derived as module
from sb3_follow_object.any_task import tasks
from sb3_follow_object.any_task.derived import Derived, derived
from sb3_follow_object.any_task.resets import record_resets
from sb3_follow_object.any_task.scene import POINT, _surface
from sb3_follow_object.any_task.simulation import DerivedObjectVecEnv, turned_about_vertical
from sb3_follow_object.any_task.tasks import kept_as
from sb3_follow_object.envs.surface import no_edge
from sb3_follow_object.settings.presets import run_config

pytestmark = pytest.mark.usefixtures("few_resets")


class Tidy(Kitchen):
    """A kitchen with goals on the bench or above it; the shelf stands elsewhere in each episode."""

    lift = 0.0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.model.body("shelf").pos[:2] = self.np_random.uniform(0.4, 0.6, 2)
        mujoco.mj_forward(self.model, self.data)
        achieved = self._observation()["achieved_goal"]
        self.goal = achieved + self.np_random.uniform([-0.1, -0.1, 0.0], [0.1, 0.1, self.lift])
        return self._observation(), {}

    def _observation(self) -> dict[str, np.ndarray]:
        return {**super()._observation(), "desired_goal": getattr(self, "goal", np.zeros(3))}

    def step(self, action: np.ndarray) -> Any:
        obs, _, _, _, _ = super().step(action)
        success = bool(self.is_success(obs["achieved_goal"], obs["desired_goal"]))
        return obs, success - 1.0, False, False, {"is_success": success}

    def is_success(self, achieved: np.ndarray, desired: np.ndarray) -> Any:
        return np.linalg.norm(achieved - desired, axis=-1) < 0.03

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> Any:
        return self.is_success(achieved, desired) - 1.0


class Lifting(Tidy):
    lift = 0.2


class Odd(Tidy):
    """Has a number of the name of its method beside one that answers in columns."""

    is_success = False  # type: ignore[assignment]

    def _is_success(self, achieved: np.ndarray, desired: np.ndarray) -> Any:
        return np.linalg.norm(achieved - desired, axis=-1, keepdims=achieved.ndim > 1) < 0.03

    def step(self, action: np.ndarray) -> Any:
        obs, _, _, _, _ = Kitchen.step(self, action)
        success = bool(self._is_success(obs["achieved_goal"], obs["desired_goal"]))
        return obs, success - 1.0, False, False, {"is_success": success}

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> Any:
        return Tidy.is_success(self, achieved, desired) - 1.0


for kind in (Tidy, Lifting, Odd):
    gym.register(f"{kind.__name__}-v0", kind, max_episode_steps=40, disable_env_checker=True)


def alone(found: Derived, n_envs: int = 3, **options: Any) -> DerivedObjectVecEnv:
    return DerivedObjectVecEnv(found.scene, n_envs, 1, seed=0, **options)


def test_updates_and_tests_follow_the_length_of_episodes() -> None:
    settings = run_config("Tidy-v0").settings  # 40 steps; the preset's are 50
    assert settings["algorithm"]["gradient_steps"] == 240 * 40 // 50
    assert settings["object_algorithm"]["gradient_steps"] == 120 * 40 // 50
    assert settings["reach"]["n_updates"] == 120 * 40 // 50
    assert (settings["test_every"], settings["object_test_every"]) == (5, 5)
    assert "n_updates" not in run_config(arm_and_wall.ARM).settings["reach"]


@pytest.mark.parametrize(("env_id", "standoff"), [("Lifting-v0", None), (arm_and_wall.ARM, 0.06)])
def test_methods_of_one_task_are_set_up_alike(env_id: str, standoff: float | None) -> None:
    """Rivals have FO's budget and replay, and reach where FO's objects on a surface have it."""
    fo, rher, her = (run_config(env_id, method=method) for method in ("fo", "rher", "her"))
    assert fo.total_timesteps == rher.total_timesteps == her.total_timesteps
    within = derived(env_id).success_distance
    for run in (fo, rher, her):
        replay = run.settings["algorithm"]["replay_buffer_kwargs"]
        assert replay == fo.settings["algorithm"]["replay_buffer_kwargs"]
        assert replay["moved_distance"] == replay["min_goal_distance"] == within
    assert rher.settings["reach"].get("standoff") == standoff
    assert her.settings.get("reach") is None


def test_the_tutorials_task_is_found_out() -> None:
    found = derived(arm_and_wall.ARM)
    assert (found.object.name, found.horizon) == ("box", 50)
    assert found.effector is not None and found.effector.entries == (0, 1, 2)
    assert (found.success_distance, found.on_surface, found.varying) == (0.05, True, ())
    assert found.second is None, "nothing else can move"


def test_episodes_begin_as_the_tasks_do() -> None:
    found = derived(arm_and_wall.ARM)
    env = alone(found, 30)
    obs = env.reset()
    for start, goal in zip(obs["achieved_goal"], obs["desired_goal"], strict=True):
        row = int(np.argmin(np.abs(found.resets.goals - goal).sum(axis=1)))
        np.testing.assert_array_equal(goal, found.resets.goals[row])
        np.testing.assert_allclose(start, found.resets.starts[row], atol=1e-6)
    assert len(np.unique(obs["achieved_goal"][:, 0])) > 15, "not the same episode again"
    env.close()


def test_what_stands_elsewhere_in_each_episode_does_so_here() -> None:
    found = derived("Tidy-v0")
    assert found.varying == ("shelf",)
    env = alone(found)
    env.reset()
    shelf = int(found.scene.model.body("shelf").mocapid[0])
    places = np.array([data.mocap_pos[shelf] for data in env.data])
    recorded = found.resets.places[:, :, :3]
    for place in places:
        assert np.abs(recorded - place).max(axis=2).min() == 0.0
    assert len(np.unique(places[:, 0])) == 3
    env.close()


def test_an_object_on_a_surface_keeps_height_and_tilt() -> None:
    env = alone(derived("Tidy-v0"), 2, on_table=True)
    env.reset()
    first = env.simulation.read["first_pose"].copy()
    env.step(np.ones((2, 7)))
    np.testing.assert_array_equal(env.simulation._target_pos[:, 2], first[:, 2])
    turn = turned_about_vertical(env.simulation._target_quat, first[:, 3:])
    np.testing.assert_allclose(turn, env.simulation._target_quat, atol=1e-12)
    env.close()


def test_an_object_on_a_surface_is_kept_off_its_edge() -> None:
    scene = derived("ArmAndWall-v0").scene
    table = scene.model.geom("table")
    env = alone(derived("ArmAndWall-v0"), 1, on_table=True)
    env.reset()
    for _ in range(40):
        obs = env.step(-np.eye(7)[:1])[0]  # to the side where no wall stands
    half = scene.model.geom_size[scene.model.body("box").geomadr[0]]
    edge = table.pos[0] - table.size[0] + half[0]
    assert scene.surface[0, 0] == pytest.approx(edge)
    assert obs["achieved_goal"][0, 0] == pytest.approx(edge, abs=2e-3)
    env.close()


def test_a_surface_beyond_which_episodes_begin_has_no_edge() -> None:
    scene = derived("ArmAndWall-v0").scene
    qpos = scene.qpos.copy()
    joint = scene.model.jnt_qposadr[scene.model.body_jntadr[scene.welded]]
    qpos[3, joint + 1] = scene.surface[1, 1] + 0.01
    assert np.isinf(_surface(replace(scene, qpos=qpos), scene.goals)).all()


@pytest.mark.parametrize(
    ("beyond", "kept"),
    [((0.04, 0.0), True), ((0.06, 0.0), False), ((0.03, 0.03), True), ((0.045, 0.045), False)],
)
def test_goals_out_of_reach_from_a_surface_take_its_edge_away(
    beyond: tuple[float, float], kept: bool
) -> None:
    scene = derived("ArmAndWall-v0").scene  # a goal is reached within 5 cm
    goals = scene.goals.copy()
    goals[3, :2] = scene.surface[1] + beyond
    assert np.isfinite(_surface(scene, goals)).all() == kept


def test_what_is_kept_of_a_task_without_an_edge_is_not_called_otherwise(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = derived("ArmAndWall-v0")
    assert kept_as("ArmAndWall-v0") == f"{found.kept_as}-edge"
    endless = replace(found, scene=replace(found.scene, surface=no_edge()))
    monkeypatch.setattr(tasks, "derived", lambda env_id: endless)
    assert kept_as("ArmAndWall-v0") == found.kept_as


@pytest.mark.parametrize(("offset", "kept"), [((0.0, 0.0, 0.15), False), ((0.0, 0.15, 0.0), True)])
def test_a_point_beside_the_objects_origin_reaches_further_and_one_above_it_does_not(
    offset: tuple[float, ...], kept: bool
) -> None:
    scene = derived("ArmAndWall-v0").scene
    model, goals = copy.copy(scene.model), scene.goals.copy()
    point = model.site(POINT).id
    model.site_pos[point], model.site_sameframe[point] = offset, 0
    goals[3, 0] = scene.surface[1, 0] + 0.18
    assert np.isfinite(_surface(replace(scene, model=model), goals)).all() == kept


def test_turns_about_the_vertical_are_all_that_is_left_of_a_turn() -> None:
    upright = np.array([[1.0, 0.0, 0.0, 0.0]])
    turned = turned_about_vertical(np.array([[0.9, 0.3, -0.2, 0.1]]), upright)
    np.testing.assert_allclose(turned, [[0.9, 0.0, 0.0, 0.1]])
    lying = np.array([[np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0]])
    np.testing.assert_allclose(turned_about_vertical(lying, lying), lying)


def test_goals_above_the_start_are_for_an_object_that_may_leave_it() -> None:
    assert derived("Tidy-v0").on_surface
    assert not derived("Lifting-v0").on_surface


def test_velocities_are_those_of_the_point_that_goals_are_about() -> None:
    env = alone(derived("Lifting-v0"), 1)
    before = env.reset()["observation"]
    rng = np.random.default_rng(0)
    for _ in range(20):
        after = env.step(0.3 * rng.uniform(-1.0, 1.0, (1, 7)))[0]["observation"]
    moved = []
    for _ in range(5):
        before, after = after, env.step(np.full((1, 7), 0.2))[0]["observation"]
        moved.append((after[0, :3] - before[0, :3], after[0, 6:9]))
    for displacement, velocity in moved[2:]:
        np.testing.assert_allclose(velocity, displacement, atol=0.004)
    env.close()


def test_one_seed_gives_one_result_and_a_copy_goes_on_alike() -> None:
    found = derived("Tidy-v0")
    rng = np.random.default_rng(1)
    actions = rng.uniform(-1.0, 1.0, (90, 3, 7))
    one, other = alone(found), alone(found)
    assert np.array_equal(one.reset()["observation"], other.reset()["observation"])
    for number, action in enumerate(actions):
        if number == 50:
            other = copy.deepcopy(other)
        expected, told = one.step(action), other.step(action)
        for key, values in expected[0].items():
            np.testing.assert_array_equal(told[0][key], values)
    assert one.horizon == 40 and one.spec.max_episode_steps == 40


def test_recorded_resets_are_kept_for_the_same_physics(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    first = derived("Tidy-v0", said.append)
    assert len(said) == 1 and "60 episodes of Tidy-v0" in said[0]
    module._LOOKED_AT.clear()
    again = derived("Tidy-v0", said.append)
    assert len(said) == 1 and again.physics == first.physics
    np.testing.assert_array_equal(again.resets.goals, first.resets.goals)
    module._LOOKED_AT.clear()

    def heavier(env: Any) -> None:
        Kitchen.__init__(env)
        env.model.body("mug").mass[0] = 0.5

    monkeypatch.setattr(Tidy, "__init__", heavier)
    other = derived("Tidy-v0", said.append)
    assert len(said) == 2 and other.physics != first.physics


def test_damaged_resets_are_recorded_anew_and_others_told(tmp_path: Path) -> None:
    first = derived("Tidy-v0")
    (path,) = tmp_path.rglob("resets.safetensors")
    whole = path.read_bytes()
    for damaged in (whole[:-100], b"", b"text", whole.replace(b"goals", b"gaols")):
        path.write_bytes(damaged)
        module._LOOKED_AT.clear()
        said: list[str] = []
        again = derived("Tidy-v0", said.append)
        assert len(said) == 1 and path.read_bytes() == whole
        np.testing.assert_array_equal(again.resets.goals, first.resets.goals)
    path.unlink()
    path.mkdir()
    module._LOOKED_AT.clear()
    with pytest.raises(ValueError, match="Is a directory"):
        derived("Tidy-v0")


def test_recorded_resets_are_those_of_what_stands_elsewhere(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    first = derived("Tidy-v0")
    reset = Tidy.reset

    def farther(env: Any, *, seed: int | None = None, options: Any = None) -> Any:
        reset(env, seed=seed)
        env.model.body("shelf").pos[0] += 0.2  # starts and goals are the same
        mujoco.mj_forward(env.model, env.data)
        return env._observation(), {}

    monkeypatch.setattr(Tidy, "reset", farther)
    module._LOOKED_AT.clear()
    other = derived("Tidy-v0")
    assert other.physics != first.physics
    shelf = int(Kitchen().model.body("shelf").id)
    moved = other.resets.places[:, shelf, 0] - first.resets.places[:, shelf, 0]
    np.testing.assert_allclose(moved, 0.2, atol=1e-9)


def test_what_no_seed_says_again_is_no_part_of_the_physics(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng()

    def unseeded(env: Any, *, seed: int | None = None, options: Any = None) -> Any:
        Kitchen.reset(env)  # the mug lies where no seed says
        env.data.joint(2).qpos[0] += rng.uniform(0.0, 0.01)
        mujoco.mj_forward(env.model, env.data)
        env.goal = np.array([0.5, 0.0, 0.23])
        return env._observation(), {}

    monkeypatch.setattr(Tidy, "reset", unseeded)
    digests = set()
    for _ in range(2):
        module._LOOKED_AT.clear()
        digests.add(derived("Tidy-v0").physics)
    assert len(digests) == 1


def test_success_is_what_a_method_says_in_columns_too() -> None:
    assert derived("Odd-v0").success_distance == pytest.approx(0.03, abs=1e-4)


def test_goals_that_no_seed_says_again_are_recorded_anew_once_they_are_elsewhere(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(0)
    reset = Tidy.reset

    def drawn_from(low: float) -> Derived:
        def unseeded(env: Any, *, seed: int | None = None, options: Any = None) -> Any:
            reset(env, seed=seed)
            env.goal = rng.uniform([low, 0.0, 0.2], [low + 0.2, 0.1, 0.2])
            return env._observation(), {}

        monkeypatch.setattr(Tidy, "reset", unseeded)
        module._LOOKED_AT.clear()
        return derived("Tidy-v0", said.append)

    said: list[str] = []
    first, again = drawn_from(0.0), drawn_from(0.0)
    np.testing.assert_array_equal(again.resets.goals, first.resets.goals)
    assert len(said) == 1 and first.kept_as == first.physics
    other = drawn_from(0.5)
    assert other.resets.goals[:, 0].min() >= 0.5 and other.physics == first.physics
    assert said[1].startswith("episodes of Tidy-v0 begin elsewhere now") and len(said) == 3
    assert kept_as("Tidy-v0").startswith(f"{first.physics}.1-"), "and F_phi is another"
    np.testing.assert_array_equal(drawn_from(0.5).resets.goals, other.resets.goals)
    np.testing.assert_array_equal(drawn_from(0.0).resets.goals, first.resets.goals)


def test_an_object_alone_is_drawn_and_has_no_window(can_draw: None) -> None:
    env = alone(derived("Tidy-v0"), 2)
    env.reset()
    images = env.get_images()
    assert [image.shape for image in images] == [(480, 480, 3)] * 2  # type: ignore[union-attr]
    red, green, blue = np.moveaxis(images[0].astype(int), -1, 0)  # type: ignore[union-attr]
    assert ((red > 2 * green) & (red > 2 * blue) & (red > 40)).sum() > 20, "the goal"
    with pytest.raises(ValueError, match="has no window; get_images"):
        env.render("human")
    env.close()


def test_resets_are_recorded_without_what_older_mujoco_lacks(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delattr(mujoco, "mj_copyData")  # 3.3.0 has none
    env = Tidy()
    resets, model, data = record_resets(env, 2)
    env.reset(seed=1)
    np.testing.assert_array_equal(data.xpos, resets.places[0, :, :3])
    assert model.nbody == env.model.nbody
