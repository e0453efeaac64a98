"""The three stages end to end, tiny: they run, they are determined by the seed, they resume."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.evaluation import evaluate_policy
from tiny_runs import bare_run

from sb3_follow_object.common.seeds import stream_seed
from sb3_follow_object.envs import make_vec, physics_id
from sb3_follow_object.follow_object.follow_object import FollowObject
from sb3_follow_object.imagination.goal_predictor import GoalPredictor
from sb3_follow_object.runs.evaluation import evaluate
from sb3_follow_object.runs.experiment import train
from sb3_follow_object.settings.methods import METHODS
from sb3_follow_object.settings.presets import run_config
from sb3_follow_object.settings.run_config import RunConfig

ENV = "FollowObject/PushSideGap-v0"
SMALL_NET: dict[str, Any] = {
    "batch_size": 32,
    "buffer_size": 2000,
    "gradient_steps": 2,
    "policy_kwargs": {"net_arch": [16, 16]},
}
TINY: dict[str, Any] = {
    "n_envs": 2,
    "n_threads": 1,
    "algorithm": SMALL_NET,
    "object_algorithm": {**SMALL_NET, "gradient_steps": 1},
    "object_timesteps": 1600,
    "n_paths": 32,
    "predictor_fit": {"hidden": (16, 16), "epochs": 1},
    "inverse_fit": {"hidden": (16, 16), "updates": 10},
    "curriculum": {"threshold": 0.0},  # every test advances: the curriculum is exercised
}
STEPS_AFTER_OBJECT = 1200


@pytest.fixture(scope="module")
def predictor() -> GoalPredictor:
    run = bare_run(ENV, **TINY)
    made = run.object_stage.learn_predictor()
    assert run.object_steps >= 1600
    run.close()
    return made


def weights(run: FollowObject) -> np.ndarray:
    assert run.model is not None
    return th.cat([p.detach().ravel() for p in run.model.policy.parameters()]).numpy()


def test_learn_counts_every_step(predictor: GoalPredictor) -> None:
    run = bare_run(ENV, predictor=predictor, **TINY)
    run.learn(STEPS_AFTER_OBJECT)
    assert run.env_steps >= STEPS_AFTER_OBJECT
    assert run.curriculum.k_max > 2
    # Tests are stored: the buffer holds training and test steps alike.
    assert run.model is not None and run.model.replay_buffer is not None
    assert run.model.replay_buffer.table.n_transitions() == run.model.num_timesteps
    assert run.test_steps == (run.curriculum.k_max - 2) * 2 * run.horizon
    assert run.env_steps == run.model.num_timesteps
    obs = run.env.reset()
    assert run.predict(obs)[0].shape == (2, 4)  # type: ignore[arg-type]
    start = np.ones(2, dtype=bool)
    assert run.predict(obs, None, start, True)[1] is None  # type: ignore[arg-type]
    mean_return, _ = evaluate_policy(run, run.env, n_eval_episodes=2, warn=False)  # type: ignore[arg-type]
    assert -run.horizon <= mean_return <= 0  # type: ignore[operator]


def test_same_seed_same_weights(predictor: GoalPredictor) -> None:
    results = []
    for seed in (0, 0, 1):
        run = bare_run(ENV, predictor=predictor, seed=seed, **TINY)
        run.learn(600)
        results.append(weights(run))
    np.testing.assert_array_equal(results[0], results[1])
    assert not np.array_equal(results[0], results[2])


def test_threads_do_not_change_the_result(predictor: GoalPredictor) -> None:
    results = []
    for n_threads in (1, 2):
        run = bare_run(ENV, predictor=predictor, **{**TINY, "n_threads": n_threads})
        run.learn(600)
        results.append(weights(run))
        run.close()
    np.testing.assert_array_equal(results[0], results[1])


@pytest.mark.parametrize("imagine", [True, False])
def test_resumed_equals_uninterrupted(
    predictor: GoalPredictor, imagine: bool, tmp_path: Path
) -> None:
    settings = {**TINY, "imagine": imagine, "predictor": predictor if imagine else None}
    whole = bare_run(ENV, **settings)
    whole.learn(600)
    part = bare_run(ENV, **settings)
    part.learn(300)
    part.save(tmp_path / "run")
    part.close()
    resumed = FollowObject.load(tmp_path / "run")
    resumed.learn(600)
    assert resumed.env_steps == whole.env_steps
    assert resumed.curriculum.k_max == whole.curriculum.k_max
    np.testing.assert_array_equal(weights(resumed), weights(whole))


def test_small_save_trains_on_from_empty_replay(predictor: GoalPredictor, tmp_path: Path) -> None:
    run = bare_run(ENV, predictor=predictor, **TINY)
    run.learn(600)
    run.save(tmp_path / "run", replay_buffer=False)
    loaded = FollowObject.load(tmp_path / "run")
    assert loaded.model is not None and run.model is not None
    before = float(loaded.model.moments.count)
    assert before == float(run.model.moments.count)
    loaded.learn(run.env_steps + 200)
    stored = loaded.model.replay_buffer.pos * loaded.env.num_envs  # type: ignore[union-attr]
    # A row as shown and one as achieved for each transition, and nothing of the empty slots.
    assert float(loaded.model.moments.count) == pytest.approx(before + 2 * stored)
    assert (loaded.model.moments.var > 0.0).all()


def test_save_replaces_everything_of_an_earlier_one(
    predictor: GoalPredictor, tmp_path: Path
) -> None:
    settings = {**TINY, "predictor_fit": {"hidden": (8,), "epochs": 1}, "object_timesteps": 800}
    other = bare_run(ENV, seed=1, **settings).object_stage.learn_predictor()
    start, goal, k = np.full((1, 3), 0.5), np.full((1, 3), 0.6), np.array([3])
    for each in (predictor, other):
        run = bare_run(ENV, predictor=each, **TINY)
        run.save(tmp_path / "run")
        loaded = FollowObject.load(tmp_path / "run").predictor
        assert loaded is not None
        np.testing.assert_array_equal(loaded.predict(start, goal, k), each.predict(start, goal, k))
    bare_run(ENV, imagine=False, **TINY).save(tmp_path / "run")
    assert FollowObject.load(tmp_path / "run").predictor is None


def test_save_leaves_a_runs_folder_alone(tmp_path: Path) -> None:
    (tmp_path / "predictor").mkdir()
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(ValueError, match="is the folder of a run; save into another one"):
        bare_run(ENV, imagine=False, **TINY).save(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"predictor", "config.json"}


def test_save_keeps_train_freq_and_refuses_python_objects(
    predictor: GoalPredictor, tmp_path: Path
) -> None:
    algorithm = {**TINY["algorithm"], "train_freq": (1, "episode")}
    run = bare_run(ENV, predictor=predictor, **{**TINY, "algorithm": algorithm})
    run.learn(300)
    run.save(tmp_path / "run")
    loaded = FollowObject.load(tmp_path / "run")
    np.testing.assert_array_equal(weights(loaded), weights(run))

    kwargs = {"policy_kwargs": {"activation_fn": th.nn.Tanh}}
    with pytest.warns(UserWarning, match=r"activation_fn is .* a Python object, which save"):
        run = bare_run(ENV, imagine=False, **{**TINY, "algorithm": kwargs})
    with pytest.raises(ValueError, match=r"activation_fn is .* a Python object, which save"):
        run.save(tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_function_is_a_callback(predictor: GoalPredictor) -> None:
    calls: list[int] = []

    def count(local: dict[str, Any], others: dict[str, Any]) -> bool:
        calls.append(1)
        return True

    bare_run(ENV, predictor=predictor, **TINY).learn(300, callback=count)
    assert calls


def test_run_folder_resumes_and_is_evaluated_again(
    predictor: GoalPredictor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = {key: value for key, value in TINY.items() if key != "predictor"}
    config = RunConfig(
        ENV,
        total_timesteps=3600,
        settings=settings,
        eval_every=400,
        n_eval_episodes=8,
        n_final_episodes=8,
        checkpoint_minutes=1e-9,
    )
    whole = train(config, tmp_path / "whole", report=lambda sentence: None)

    def interrupt(figures: dict[str, Any]) -> None:
        if figures["env_steps"] > 3000:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(config, tmp_path / "part", report=lambda sentence: None, progress=interrupt)
    resumed = train(config, tmp_path / "part", resume=True, report=lambda sentence: None)
    for key in ("env_steps", "object_steps", "test_steps", "success_rate", "k_max"):
        assert resumed[key] == whole[key]
    for name in ("policy.safetensors", "best_policy.safetensors"):
        assert (tmp_path / "part" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()

    def without_wall(folder: str) -> list[list[str]]:
        rows = (tmp_path / folder / "evaluations.csv").read_text().splitlines()
        column = rows[0].split(",").index("wall_s")
        return [[v for i, v in enumerate(row.split(",")) if i != column] for row in rows]

    assert without_wall("part") == without_wall("whole")
    again = evaluate(tmp_path / "part" / "policy.safetensors", ENV, 8)
    assert again.success_rate == resumed["success_rate"]

    with pytest.raises(ValueError, match="is not empty"):
        train(config, tmp_path / "part", report=lambda sentence: None)
    with pytest.raises(ValueError, match="no run"):
        train(config, tmp_path / "nothing", resume=True, report=lambda sentence: None)


def test_predictor_for_another_task_is_refused(predictor: GoalPredictor, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="was made for FollowObject/PushSideGap-v0"):
        bare_run("FollowObject/PnPShelf-v0", predictor=predictor)
    predictor.save(tmp_path / "predictor")
    assert GoalPredictor.load(tmp_path / "predictor").physics == physics_id(ENV)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"n_envs": 0}, "n_envs"),
        ({"algorithm": {"batchsize": 3}}, "did you mean 'batch_size'"),
        ({"inverse_fit": {"update": 3}}, "did you mean 'updates'"),
        ({"inverse_fit": {"updates": 0}}, "inverse_fit: updates is 0; it must be at least 1"),
        ({"algorithm": {"auxiliary": {"name": "x"}}}, "auxiliary has no reward 'x'"),
        ({"curriculum": {"p": 2.0}}, "curriculum: p is 2.0; it must lie in"),
        ({"curriculum": {"k_max": 51}}, "k_max is 51; it must be at most 50"),
        ({"curriculum": {"threshold": -0.1}}, "threshold is -0.1; it must lie in"),
        ({"env_id": "FollowObject/PnPShelve-v0"}, "FollowObject/PnPShelf-v0"),
    ],
)
def test_bad_input_is_one_sentence(arguments: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence) as error:
        bare_run(**{"env_id": ENV, **arguments})
    assert "\n" not in str(error.value)


def test_object_on_table_stays_on_the_table() -> None:
    highest = []
    for on_table in (False, True):
        env = make_vec("FollowObject/PushSideGapObject-v0", 8, 1, seed=0, on_table=on_table)
        rng = np.random.default_rng(0)
        obs = env.reset()
        start = obs["achieved_goal"][:, 2]
        rise = 0.0
        for _ in range(49):
            obs, *_ = env.step(rng.uniform(-1, 1, (8, 7)) + np.array([0, 1, 0.3, 0, 0, 0, 0]))
            rise = max(rise, float((obs["achieved_goal"][:, 2] - start).max()))
        highest.append(rise)
        env.close()
    assert highest[0] > 0.2
    assert highest[1] < 0.01


def test_streams_of_a_run_are_unrelated() -> None:
    seeds = [stream_seed(seed, name) for seed in range(50) for name in ("robot", "final test")]
    assert len(set(seeds)) == len(seeds)


@pytest.mark.parametrize("method", ["her", "shaped"])
def test_preset_learns_what_the_run_folder_learns(method: str, tmp_path: Path) -> None:
    small = {"batch_size": 16, "gradient_steps": 2, "buffer_size": 2000, "learning_starts": 200}
    copies, net = {"n_envs": 2, "n_threads": 1}, [8]
    changes = {**copies, **small, "policy_kwargs.net_arch": net}
    config = run_config(ENV, method=method, seed=5, overrides=changes)
    train(replace(config, total_timesteps=600, n_final_episodes=1), tmp_path / "run", report=print)
    algorithm = {**small, "policy_kwargs": {"net_arch": net}}
    run = FollowObject(ENV, method=method, seed=5, algorithm=algorithm, **copies)
    run.learn(600)
    run.save_policy(tmp_path / "policy.safetensors")
    ours, theirs = tmp_path / "policy.safetensors", tmp_path / "run" / "policy.safetensors"
    assert ours.read_bytes() == theirs.read_bytes()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("env_id", [ENV, "FollowObject/PnPInsertion-v0"])
def test_without_settings_it_has_those_of_train(env_id: str, method: str) -> None:
    settings = FollowObject(env_id, method=method).settings
    for name, value in run_config(env_id, method=method).settings.items():
        assert settings[name] == value, name


def test_what_is_given_of_a_mapping_leaves_the_rest_to_the_preset() -> None:
    preset = FollowObject(ENV).settings
    algorithm = {"policy_kwargs": {"net_arch": [8]}, "batch_size": 16}
    ours = FollowObject(ENV, algorithm=algorithm, curriculum={"p": 0.5}, reach=None).settings
    assert "reach" in preset and "reach" not in ours
    assert ours["curriculum"] == {**preset["curriculum"], "p": 0.5}
    policy = {**preset["algorithm"]["policy_kwargs"], "net_arch": [8]}
    assert ours["algorithm"] == {
        **preset["algorithm"],
        "batch_size": 16,
        "policy_kwargs": policy,
    }
    assert "n_levels" not in FollowObject(ENV, preset=None).settings["curriculum"]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"n_env": 3}, "did you mean 'n_envs'"),
        ({"algorithm": {"batchsize": 3}}, "did you mean 'batch_size'"),
        ({"batch_size": 3}, r"of the robot's algorithm: algorithm={'batch_size': \.\.\.}"),
        ({"n_timesteps": 3}, "n_timesteps is of a run folder"),
        ({"solved_at": 0.5}, "solved_at is of a run folder"),
        ({"imagine": False}, "the method says whether goals are imagined"),
        ({"method": "her", "preset": None}, "with these settings it is method 'fo', not 'her'"),
        ({"method": "her", "reach": {}}, "it is method 'rher', not 'her'"),
        ({"method": "shaped", "reward_type": "sparse"}, "it is method 'her', not 'shaped'"),
        ({"method": ""}, "there is no method ''"),
        ({"method": ["fo"]}, r"there is no method \['fo'\]"),
        ({"torch_threads": 2}, "update_threads"),
        ({"env_id": 5}, "5 is no environment's id"),
        ({"env_id": "FollowObject/PushSideGapObject-v0"}, f"the object alone.*{ENV}"),
        ({"predictor": "auto"}, "must be of the class GoalPredictor, not 'auto'"),
        ({"object_networks": 3}, "must be of the class ObjectNetworks, not 3"),
        ({"report": 5}, "report must be a function"),
        ({"goal": 5}, "goal must be a function, not 5"),
        ({"method": "her", "lift": True}, "nothing of this method reads lift"),
        ({"method": "herr"}, "did you mean 'her'"),
        ({"preset": "papers"}, "did you mean 'paper'"),
        ({"method": "rher", "preset": "paper"}, "'rher' has no preset 'paper'"),
    ],
)
def test_what_is_said_in_the_wrong_place_is_one_sentence(
    arguments: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(ValueError, match=sentence):
        FollowObject(**{"env_id": ENV, **arguments})


@pytest.mark.parametrize("steps", [300_000.0, -1, "many"])
def test_wrong_steps_are_refused_before_the_object_learns(
    steps: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = bare_run(ENV, **TINY)
    monkeypatch.setattr(run.object_stage, "learn_predictor", lambda: pytest.fail("it learns"))
    with pytest.raises(ValueError, match="total_timesteps"):
        run.learn(steps)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"callback": "x"}, "callback must be SB3's, a function, or a list of these, not 'x'"),
        ({"callback": [None, 3]}, "or a list of these, not 3"),
        ({"log_interval": 0}, "log_interval is 0; it must be at least 1"),
    ],
)
def test_what_learn_cannot_take_is_refused_before_the_object_learns(
    arguments: dict[str, Any], sentence: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = bare_run(ENV, **TINY)
    monkeypatch.setattr(run.object_stage, "learn_predictor", lambda: pytest.fail("it learns"))
    with pytest.raises(ValueError, match=sentence):
        run.learn(3000, **arguments)


def test_fewer_steps_than_a_robot_has_had_are_not_the_objects_fault(
    predictor: GoalPredictor,
) -> None:
    said: list[str] = []
    run = bare_run(ENV, **TINY, predictor=predictor, report=said.append).learn(600)
    assert run.learn(300).env_steps >= 600
    assert not [sentence for sentence in said if "none were left" in sentence]
    run.close()


def test_steps_that_end_with_the_objects_stage_are_told() -> None:
    said: list[str] = []
    run = bare_run(ENV, **TINY, report=said.append).learn(1000)
    assert run.object_steps >= 1600
    assert run.env_steps == run.object_steps
    assert said[-1].endswith(
        f"{run.object_steps:,} env steps of 1,000: none were left for the robot"
    )
    run.close()


@pytest.mark.parametrize(
    ("environment", "sentence"),
    [
        ({"env_id": "FollowObject/PnPShelf-v0"}, f"is of {ENV}; load.* can make it of no other"),
        ({"object": "object0"}, f"is of {ENV}; load.* can make it of no other"),
        ({"objet": "object0"}, "no setting 'objet'; did you mean 'object'"),
    ],
)
def test_a_save_is_loaded_for_its_own_environment(
    environment: dict[str, Any], sentence: str, predictor: GoalPredictor, tmp_path: Path
) -> None:
    bare_run(ENV, predictor=predictor, **TINY).save(tmp_path / "save")
    with pytest.raises(ValueError, match=sentence):
        FollowObject.load(tmp_path / "save", **environment)
    assert FollowObject.load(tmp_path / "save", env_id=ENV).env_id == ENV


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"algorithm": {"action_noise": 5}}, "action_noise must be SB3.s ActionNoise, not 5"),
        ({"algorithm": {"noise_std": -1.0}}, "noise_std"),
        ({"algorithm": {"replay_buffer_kwargs": {"moved_rato": 0.5}}}, "moved_rato"),
        ({"algorithm": {"seed": 1}}, "algorithm has no setting 'seed'"),
        ({"object_algorithm": {"policy": "MlpPolicy"}}, "object_algorithm has no setting 'policy'"),
        ({"object_algorithm": {"tau": 2.0}}, "tau is 2.0"),
        ({"curriculum": {"horizon": 5}}, "curriculum has no setting 'horizon'"),
        ({"predictor_fit": {"seed": 1}}, "predictor_fit has no setting 'seed'"),
        ({"predictor_fit": {"test_share": 2.0}}, "test_share is 2.0; it must lie in"),
        ({"n_test_episodes": 0}, "n_test_episodes is 0"),
        ({"n_paths": 1}, "n_paths is 1"),
        (
            {
                "reward_type": "dense",
                "algorithm": {"replay_buffer_kwargs": {"goal_margin": 0.3}},
            },
            "goal_margin is for environments that pay by whether a goal is near enough",
        ),
    ],
)
def test_wrong_settings_are_refused_before_the_object_learns(
    settings: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(ValueError, match=sentence):
        bare_run(ENV, **{**TINY, **settings}, report=pytest.fail).learn(2000)  # type: ignore


def test_an_id_may_name_its_module() -> None:
    assert bare_run(f"sb3_follow_object:{ENV}", **TINY).env_id == ENV
