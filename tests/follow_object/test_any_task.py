"""All three stages in an environment that nobody here wrote."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import arm_and_wall
import gymnasium as gym
import moving_wall
import numpy as np
import pytest
import torch as th
from gymnasium.wrappers import TimeLimit
from kept_states import keeping
from small_models import weights
from tiny_runs import SMALL_NET, TINY, bare_run, config, quiet

from sb3_follow_object.any_task import derived as looking
from sb3_follow_object.any_task import registering
from sb3_follow_object.any_task.tasks import kept_as
from sb3_follow_object.common.cache import CACHE_VARIABLE
from sb3_follow_object.comparison.cells import Settings
from sb3_follow_object.comparison.grid import plan
from sb3_follow_object.envs import robot_copies
from sb3_follow_object.follow_object.follow_object import FollowObject
from sb3_follow_object.follow_object.saved_folder import read
from sb3_follow_object.imagination.goal_predictor import GoalPredictor
from sb3_follow_object.imagination.predictor_files import FACTS_FILE
from sb3_follow_object.imagination.wrapper import ImaginedGoalWrapper
from sb3_follow_object.object_stage import stage as stages
from sb3_follow_object.object_stage.policy import ObjectProgress
from sb3_follow_object.reach.wrapper import ReachFirstWrapper
from sb3_follow_object.runs import predictor_cache
from sb3_follow_object.settings.presets import run_config

ARM = arm_and_wall.ARM
LONGER = "Longer-v0"
gym.register(LONGER, arm_and_wall.ArmAndWall, max_episode_steps=150)


@pytest.fixture(autouse=True)
def few_resets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    monkeypatch.setattr(looking, "N_RESETS", 60)
    monkeypatch.setattr(looking, "_LOOKED_AT", {})


def test_a_save_goes_on_as_the_whole_does(tmp_path: Path) -> None:
    settings = {**TINY, "reach": {"n_updates": 3, "batch_size": 16}}
    whole = bare_run(ARM, **settings).learn(3200)
    part = bare_run(ARM, **settings).learn(2800)
    assert part.model is not None and part.settings["reach"]["effector"] == (0, 1, 2)
    assert part.predictor is not None and part.predictor.object_on_table
    part.save(tmp_path / "part")
    resumed = FollowObject.load(tmp_path / "part").learn(3200)
    assert whole.model is not None and resumed.model is not None
    assert resumed.env_steps == whole.env_steps > part.env_steps
    th.testing.assert_close(weights(resumed.model), weights(whole.model), rtol=0, atol=0)


def test_a_save_of_an_environment_that_a_function_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def made() -> gym.Env:
        return TimeLimit(arm_and_wall.ArmAndWall(), 50)  # type: ignore[attr-defined]

    run = bare_run(make_env=made, imagine=False, **TINY).learn(400)
    run.save(tmp_path / "run")
    monkeypatch.delitem(gym.registry, run.env_id)  # as in another process
    with pytest.raises(ValueError, match="came with functions: give load\\(\\) make_env="):
        FollowObject.load(tmp_path / "run")
    again = FollowObject.load(tmp_path / "run", make_env=made)
    assert (again.env_id, again.env_steps) == (run.env_id, run.env_steps)
    with pytest.raises(ValueError, match="is another environment here"):
        FollowObject.load(tmp_path / "run", make_env=lambda: made())
    monkeypatch.delitem(gym.registry, run.env_id)
    monkeypatch.setattr(registering, "_GIVEN", {})
    with pytest.raises(ValueError, match="of another environment: steps 40 instead of 50"):
        FollowObject.load(
            tmp_path / "run",
            make_env=lambda: TimeLimit(arm_and_wall.ArmAndWall(), 40),  # type: ignore[attr-defined]
        )
    monkeypatch.delitem(gym.registry, run.env_id)
    with pytest.raises(ValueError, match="came with functions: give load\\(\\) make_env="):
        FollowObject.load(tmp_path / "run", env_id=ARM)


@pytest.mark.parametrize(
    ("env_id", "sentence"),
    [
        ("CartPole-v1", "has no goals: .*; say with goal= and is_success="),
        ("Endless-v0", "does not say how long its episodes are; register it with max_episode_st"),
    ],
)
def test_what_is_missing_is_said_at_once(env_id: str, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        bare_run(env_id, **TINY)


class Paid(arm_and_wall.ArmAndWall):  # type: ignore[name-defined, misc]
    """Pays 1 on the goal, for one goal at a time, and does not tell success."""

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> Any:
        return float(np.linalg.norm(achieved - desired) < 0.05)

    def step(self, action: np.ndarray) -> Any:
        obs, _, terminated, truncated, _ = super().step(action)
        reward = self.compute_reward(obs["achieved_goal"], obs["desired_goal"], {})
        return obs, reward, terminated, truncated, {}


gym.register("Paid-v0", Paid, max_episode_steps=50)
gym.register("Endless-v0", arm_and_wall.ArmAndWall)


def test_the_wrappers_find_what_follow_object_finds() -> None:
    def tip(env: Any) -> np.ndarray:
        return env.data.site("tip").xpos

    env_id = bare_run("Paid-v0", effector=tip, **TINY).env_id
    reaching = ReachFirstWrapper(gym.make(env_id))
    expected = bare_run("Paid-v0", effector=tip, **TINY, reach={}).settings["reach"]
    found = reaching.reach_settings()
    assert tuple(found.effector) == tuple(expected["effector"]) == (21, 22, 23)
    assert found.max_steps == expected["max_steps"] == 25
    assert ReachFirstWrapper(gym.make(env_id), max_steps=7).reach_settings().max_steps == 7

    env = ImaginedGoalWrapper(gym.make("Paid-v0"), curriculum={"p": 0.0})
    obs, _ = env.reset(seed=0)
    _, reward, _, _, info = env.step(env.action_space.sample())
    assert reward == -1.0 and info["is_success"] is False
    goals = np.tile(obs["desired_goal"], (3, 1))
    paid = env.get_wrapper_attr("compute_reward")(
        goals, goals + np.array([[0.0], [0.1], [0.0]]), {}
    )
    np.testing.assert_array_equal(paid, [0.0, -1.0, 0.0])


class Told(arm_and_wall.ArmAndWall):  # type: ignore[name-defined, misc]
    """Tells nothing of the robot in metres."""

    def _observation(self) -> dict[str, np.ndarray]:
        told = super()._observation()
        return {**told, "observation": 10.0 * told["observation"]}


gym.register("Told-v0", Told, max_episode_steps=50)


def test_a_wrapper_that_finds_no_effector_says_so() -> None:
    with pytest.raises(ValueError, match="no part of the robot has its position in metres"):
        ReachFirstWrapper(gym.make("Told-v0"))
    assert ReachFirstWrapper(gym.make("Told-v0"), effector=(0, 1, 2)).reach_settings()


def test_reaching_takes_what_a_task_of_others_says_of_it() -> None:
    def elbow(env: Any) -> np.ndarray:
        return env.data.body("forearm").xpos

    def long() -> gym.Env:
        return TimeLimit(arm_and_wall.ArmAndWall(), 120)  # type: ignore[attr-defined]

    for imagine in (True, False):
        settings = {**TINY, "imagine": imagine, "reach": {}}
        known = bare_run(ARM, **settings).settings["reach"]
        assert (known["effector"], known["max_steps"]) == ((0, 1, 2), 25)
        slow = bare_run(make_env=long, effector=elbow, **settings).settings["reach"]
        assert (slow["effector"], slow["max_steps"]) == ((21, 22, 23), 60)
    given = bare_run(make_env=long, **{**TINY, "reach": {"max_steps": 7, "effector": [3, 4, 5]}})
    assert given.settings["reach"]["max_steps"] == 7
    assert tuple(given.settings["reach"]["effector"]) == (3, 4, 5)


class Scaled(arm_and_wall.ArmAndWall):  # type: ignore[name-defined, misc]
    """Tells everything in decimetres."""

    def _observation(self) -> dict[str, np.ndarray]:
        told = super()._observation()
        return {**told, "observation": 10.0 * told["observation"]}


def test_a_robot_whose_place_is_not_told_cannot_reach_and_may_be_told() -> None:
    def scaled() -> gym.Env:
        return TimeLimit(Scaled(), 50)

    with pytest.raises(ValueError, match="no part of the robot has its position in metres"):
        bare_run(make_env=scaled, **TINY, reach={})
    told = bare_run(
        make_env=scaled, effector=lambda env: env.data.site("tip").xpos, **TINY, reach={}
    )
    assert told.settings["reach"]["effector"] == (21, 22, 23)


def test_an_object_that_does_not_learn_on_its_surface_may_leave_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(stages, "SURFACE_STEPS", 400)
    settings = {**TINY, "object_timesteps": 1200}
    states: list[dict[str, Any]] = []
    said: list[str] = []
    run = bare_run(ARM, report=said.append, **settings)
    stage = run.object_stage
    predictor = stage.learn_predictor(keeping(states))
    assert stage.on_table is False and predictor.object_on_table is False
    assert stage.policy_steps == 400 + 1200, "both trials are counted"
    assert sum("may leave it from here on" in sentence for sentence in said) == 1
    # On from a checkpoint of the first trial, and of the second.
    for state in (states[0], states[-2]):
        again = bare_run(ARM, report=quiet, **settings).object_stage
        resumed = again.learn_predictor(state=state)
        assert again.policy_steps == stage.policy_steps
        np.testing.assert_array_equal(resumed.error_mm, predictor.error_mm)


def test_an_object_that_learned_on_is_kept_whatever_its_last_tests_say(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def learned_on(*args: Any, **kwargs: Any) -> Any:
        model, solved = train(*args, **kwargs)
        solved.rates, solved.progress = [1.0, 1.0, 0.5], ObjectProgress(until=model.num_timesteps)
        return model, solved

    train = stages.train_object_policy
    monkeypatch.setattr(stages, "train_object_policy", learned_on)
    monkeypatch.setattr(stages, "SURFACE_STEPS", 400)
    stage = bare_run(ARM, report=quiet, **{**TINY, "object_timesteps": 1200}).object_stage
    stage.learn_policy()
    assert stage.on_table is True and stage.policy_steps == 400


def test_sldr_is_refused_before_the_object_learns() -> None:
    run = bare_run(ARM, **{**TINY, "algorithm": {**SMALL_NET, "auxiliary": {"name": "sldr"}}})
    with pytest.raises(ValueError, match="needs a robot task of this package"):
        run.check()


def test_a_folders_predictor_may_be_of_paths_of_ones_own(tmp_path: Path) -> None:
    path = np.linspace([0.3, -0.2, 0.025], [0.4, 0.2, 0.025], 51)
    paths = np.tile(path, (20, 1, 1))
    predictor = GoalPredictor.fit(paths, paths[:, -1], env_id=ARM, physics="a line", epochs=1)
    predictor.save(tmp_path / "phi")
    env = ImaginedGoalWrapper(gym.make(ARM), tmp_path / "phi", {"p": 0.0})
    assert env.predictor.physics == "a line"


def test_paths_of_ones_own_may_be_as_long_as_the_robots_episodes(tmp_path: Path) -> None:
    path = np.linspace([0.3, -0.2, 0.025], [0.4, 0.2, 0.025], 151)
    paths = np.tile(path, (20, 1, 1))
    predictor = GoalPredictor.fit(paths, paths[:, -1], env_id=LONGER, physics="a line", epochs=1)
    predictor.save(tmp_path / "phi")
    for given in (predictor, tmp_path / "phi"):
        env = ImaginedGoalWrapper(gym.make(LONGER), given, {"p": 0.0})
        assert env.predictor.horizon == env.curriculum.horizon == 150
    assert ImaginedGoalWrapper(gym.make(LONGER), tmp_path / "none").curriculum.horizon == 50


def test_a_wall_that_stands_elsewhere_in_each_episode_is_seen_in_all_stages(tmp_path: Path) -> None:
    replay = {"replay_buffer_kwargs": {"imagined_ratio": 0.5}}
    settings = {**TINY, "n_envs": 4, "n_threads": 2, "algorithm": {**SMALL_NET, **replay}}
    run = bare_run(moving_wall.WALL, **settings).learn(1800)
    assert run.predictor is not None and run.predictor.context == ("wall x", "wall y")
    assert run.model is not None and run.model.replay_buffer is not None
    walls = run.model.replay_buffer.contexts[: run.model.replay_buffer.pos]  # type: ignore[attr-defined]
    assert len(np.unique(walls[..., 0])) > 4 and 0.3 <= walls[..., 0].min() < walls.max() <= 0.5
    run.save(tmp_path / "run")
    assert read(tmp_path / "run").predictor.context == run.predictor.context  # type: ignore[union-attr]
    run.close()


def test_a_predictor_that_is_found_by_itself_sees_the_wall(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(predictor_cache, "run_config", lambda env_id: config(env_id=env_id))
    env: Any = ImaginedGoalWrapper(gym.make(moving_wall.WALL), curriculum={"p": 0.0})
    env.load_curriculum(env.curriculum.state_dict())
    obs, info = env.reset(seed=0)
    np.testing.assert_allclose(info["context"], env.unwrapped.wall(), atol=1e-12)
    asked = obs["achieved_goal"][None], info["original_goal"][None], [info["imagined_level"]]
    shown = env.predictor.predict(*asked[:2], np.array(asked[2]), info["context"][None])
    np.testing.assert_allclose(obs["desired_goal"], shown[0], atol=1e-6)
    folder = tmp_path / "cache" / moving_wall.WALL / kept_as(moving_wall.WALL)
    assert (folder / FACTS_FILE).exists()
    env.close()


def test_an_id_has_one_predictor_with_a_module_before_it_and_without(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    learned: list[str] = []
    learn = predictor_cache.learn_predictor

    def learn_once(run: Any, *arguments: Any) -> GoalPredictor:
        learned.append(run.env_id)
        return learn(run, *arguments)

    monkeypatch.setattr(predictor_cache, "learn_predictor", learn_once)
    monkeypatch.setattr(predictor_cache, "run_config", lambda env_id: config(env_id=env_id))
    full_id = f"arm_and_wall:{ARM}"
    predictor = predictor_cache.get_predictor(full_id, report=quiet)
    env = ImaginedGoalWrapper(gym.make(full_id), curriculum={"p": 0.0})
    np.testing.assert_array_equal(env.predictor.error_mm, predictor.error_mm)
    assert learned == [ARM]
    found = (tmp_path / "cache").rglob(FACTS_FILE)
    assert list(found) == [tmp_path / "cache" / ARM / kept_as(ARM) / FACTS_FILE]
    for env_id in (full_id, ARM):
        assert bare_run(env_id, predictor=predictor, **TINY).predictor is predictor
    with pytest.raises(ValueError, match=f"was made for {ARM} .* not for {moving_wall.WALL} "):
        bare_run(f"moving_wall:{moving_wall.WALL}", predictor=predictor, **TINY)


def test_networks_that_nothing_reads_are_not_made() -> None:
    stage = bare_run(ARM, **TINY).object_stage
    stage.learn_predictor(networks=True)
    assert stage.predictor is not None and stage.networks is None


@pytest.mark.parametrize("preset", ["default", None])
def test_whoever_waits_for_resets_is_told_so_once(preset: str | None) -> None:
    said: list[str] = []
    for _ in range(2):
        FollowObject(ARM, preset=preset, report=said.append, n_envs=1)
    assert said == [f"where 60 episodes of {ARM} begin is recorded, once"]


def test_settings_and_predictors_say_that_resets_are_recorded(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    said: list[str] = []
    run_config(ARM, method="her", report=said.append)  # which is set up as what follows it
    run_config(ARM, report=said.append)
    assert said == [f"where 60 episodes of {ARM} begin is recorded, once"]
    said.clear()
    monkeypatch.setattr(predictor_cache, "learn_predictor", lambda *_: None)
    with pytest.raises(ValueError, match=FACTS_FILE):
        predictor_cache.get_predictor(moving_wall.WALL, report=said.append)
    assert said == [f"where 60 episodes of {moving_wall.WALL} begin is recorded, once"]


def test_a_comparison_says_as_it_plans_that_resets_are_recorded(tmp_path: Path) -> None:
    said: list[str] = []
    plan(tmp_path, [ARM], ["her", "fo"], [0, 1], Settings(steps=1000), report=said.append)
    assert said == [f"where 60 episodes of {ARM} begin is recorded, once"]


def test_a_refused_curriculum_leaves_no_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[Any] = []
    begin = robot_copies._Worker.__init__

    def noting(worker: Any, *arguments: Any) -> None:
        begin(worker, *arguments)
        begun.append(worker._process)

    monkeypatch.setattr(robot_copies._Worker, "__init__", noting)
    settings = {**TINY, "n_envs": 4, "n_threads": 2, "curriculum": {"k_max": 60}}
    with pytest.raises(ValueError, match="k_max is 60"):
        bare_run(ARM, **settings)
    assert [process.poll() for process in begun] == [0, 0]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"lift": "maybe"}, "lift must be True, False or \"auto\", not 'maybe'"),
        ({"lift": True, "object_on_table": False}, "lift and object_on_table say the same"),
    ],
)
def test_what_cannot_be_meant_is_refused(arguments: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        bare_run(ARM, **TINY, **arguments)


def test_lift_is_the_users_word() -> None:
    assert bare_run(ARM, **TINY, lift=True).object_stage._choices() == (False,)
    assert bare_run(ARM, **TINY, lift=False).object_stage._choices() == (True,)
    assert bare_run(ARM, **TINY).object_stage._choices() == (True, False)


class Near(arm_and_wall.ArmAndWall):  # type: ignore[name-defined, misc]
    def is_success(self, achieved: np.ndarray, desired: np.ndarray) -> Any:
        return np.linalg.norm(achieved - desired, axis=-1) < 0.02


gym.register("Near-v0", Near, max_episode_steps=50)


def test_presets_set_a_task_up_as_the_packages_most_similar_one() -> None:
    pushed = run_config("FollowObject/PushSideGap-v0").settings
    settings = run_config(ARM).settings
    for name in ("n_paths", "object_success", "object_test_every", "object_test_episodes"):
        assert settings[name] == pushed[name], "what the preset says of all tasks"
    assert run_config(ARM).eval_every == run_config("FollowObject/PushSideGap-v0").eval_every
    assert settings["algorithm"] == pushed["algorithm"]
    assert settings["object_algorithm"] == pushed["object_algorithm"]
    near = run_config("Near-v0").settings
    assert near["curriculum"]["min_distance"] == pytest.approx(0.022)
    replay = near["algorithm"]["replay_buffer_kwargs"]
    assert (replay["moved_distance"], replay["min_goal_distance"]) == (0.02, 0.02)
    given = run_config("Near-v0", overrides={"curriculum.min_distance": 0.5}).settings
    assert given["curriculum"]["min_distance"] == 0.5


@pytest.mark.parametrize("method", ["fo", "her"])
def test_longer_episodes_have_as_many_updates_and_tests_an_env_step(method: str) -> None:
    runs = [run_config(task, method=method) for task in (ARM, LONGER)]
    assert [each.eval_every for each in runs] == [20_000, 60_000]
    usual, longer = (each.settings for each in runs)
    updates = [each["algorithm"]["gradient_steps"] for each in (usual, longer)]
    assert updates[1] == 3 * updates[0]
    if method == "fo":
        assert (usual["test_every"], longer["test_every"]) == (4, 1)
    paper = [run_config(task, method=method, preset="paper") for task in (ARM, LONGER)]
    assert paper[0].settings["algorithm"] == paper[1].settings["algorithm"]
    given = run_config(LONGER, method=method, overrides={"gradient_steps": 7})
    assert given.settings["algorithm"]["gradient_steps"] == 7


def test_an_object_that_learns_on_may_take_more_than_a_surface_is_given(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(stages, "SURFACE_STEPS", 600)
    rough = {"object_success": 0.0, "object_error": 1e-6}  # any two tests solve it
    often = {"object_n_envs": 2, "object_test_every": 1, "object_test_episodes": 2}
    settings = {**TINY, "object_timesteps": 1200, **rough, **often}
    said: list[str] = []
    states: list[dict[str, Any]] = []
    stage = bare_run(ARM, report=said.append, **settings).object_stage
    predictor = stage.learn_predictor(keeping(states))
    (steps,) = [int(s.split(" for ")[1].split()[0]) for s in said if "the object learns on" in s]
    assert steps > 600 and stage.on_table is True
    assert states[-1]["model"]["counters"]["num_timesteps"] > 600
    again = bare_run(ARM, report=quiet, **settings).object_stage
    resumed = again.learn_predictor(state=states[-1])
    np.testing.assert_array_equal(resumed.error_mm, predictor.error_mm)
