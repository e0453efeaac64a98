"""What can be copied, and how each is used."""

from __future__ import annotations

import io
from collections.abc import Callable
from contextlib import redirect_stdout
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
import toy
from reaching import REACH, StraightActor
from reaching import TASK as REACH_TOY
from small_buffers import as_arrays, fill, make_buffer, make_env
from small_models import make_model, weights
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecMonitor
from tiny import tiny_networks
from tiny_runs import bare_run

from sb3_follow_object.callbacks.curriculum_callback import CurriculumCallback
from sb3_follow_object.callbacks.eval_callback import OriginalGoalEvalCallback
from sb3_follow_object.callbacks.reach_callback import ReachCallback
from sb3_follow_object.common.array_trees import Camera
from sb3_follow_object.ddpg.auxiliary import Transitions
from sb3_follow_object.ddpg.her_ddpg import HerDDPG
from sb3_follow_object.envs import make_vec, physics_id
from sb3_follow_object.follow_object.follow_object import FollowObject
from sb3_follow_object.imagination.goal_predictor import GoalPredictor
from sb3_follow_object.imagination.vec_env import ImaginedGoalVecEnv
from sb3_follow_object.imagination.wrapper import ImaginedGoalWrapper
from sb3_follow_object.reach.actor import ReachActor
from sb3_follow_object.reach.policy import ReachPolicy
from sb3_follow_object.reach.vec_env import ReachFirstVecEnv
from sb3_follow_object.reach.wrapper import ReachFirstWrapper
from sb3_follow_object.replay.episode_table import EpisodeTable
from sb3_follow_object.replay.records import Records

ROBOT, OBJECT = "FollowObject/PnPSimpleV1-v0", "FollowObject/PnPSimpleV1Object-v0"
PUSH = "FollowObject/PushSideGap-v0"

Make = Callable[[], Any]
Use = Callable[[Any], Any]


# Environments ---------------------------------------------------------------------------------


def play_single(env: Any) -> Any:
    rng, shown = np.random.default_rng(0), []
    for _ in range(6):
        action = rng.uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32)
        shown.append(env.step(action))
    return [*shown, env.reset()]


def play_batch(env: Any) -> Any:
    rng, shown = np.random.default_rng(0), []
    for _ in range(6):
        shape = (env.num_envs, *env.action_space.shape)
        obs, rewards, dones, infos = env.step(rng.uniform(-1.0, 1.0, shape).astype(np.float32))
        clocks = ("episode",)  # a monitor's seconds
        shown.append((obs, rewards, dones, [_without(info, clocks) for info in infos]))
    return [*shown, env.reset()]


def _without(info: dict[str, Any], names: tuple[str, ...]) -> dict[str, Any]:
    return {name: value for name, value in info.items() if name not in names}


def begun_single(env: gym.Env) -> gym.Env:
    env.reset(seed=1)
    for _ in range(3):
        env.step(np.full(env.action_space.shape, 0.5, np.float32))  # type: ignore[arg-type]
    return env


def begun_batch(env: Any) -> Any:
    env.seed(1)
    env.reset()
    for _ in range(3):
        env.step(np.full((env.num_envs, *env.action_space.shape), 0.5, np.float32))
    return env


def predictor_of(horizon: int) -> toy.StraightPredictor:
    predictor = toy.StraightPredictor()
    predictor.horizon = horizon
    return predictor


def imagined_batch(n_threads: int) -> ImaginedGoalVecEnv:
    curriculum = toy.Curriculum(50, p=0.5, k_max=9)
    return ImaginedGoalVecEnv(make_vec(ROBOT, 3, n_threads), predictor_of(50), curriculum)


def imagined_single(env: gym.Env, horizon: int) -> ImaginedGoalWrapper:
    return ImaginedGoalWrapper(env, predictor_of(horizon), toy.Curriculum(horizon, p=0.5, k_max=9))


# Learning -------------------------------------------------------------------------------------


def fitted_predictor() -> GoalPredictor:
    paths, goals = toy.paths(8)
    return GoalPredictor.fit(paths, goals, env_id="x", physics="y", hidden=[64], epochs=1)


def use_predictor(predictor: GoalPredictor) -> Any:
    paths, goals = toy.paths(64, seed=1)
    return predictor.paths(paths[:, 0], goals)


def use_curriculum(curriculum: Any) -> Any:
    drawn = curriculum.draw(20, np.random.default_rng(0))
    return [drawn, curriculum.report(1.0), curriculum.k_max]


def filled_buffer(**options: Any) -> Any:
    env = make_env(2)
    buffer = make_buffer(env, 200, **options)
    fill([buffer], env, 45)
    return buffer


def use_buffer(buffer: Any) -> Any:
    if buffer.env is None:  # SB3's pickles leave it out
        buffer.set_env(make_env(2))
    first = as_arrays(buffer.sample(32))
    fill([buffer], make_env(2), 25, seed=1)
    return [first, as_arrays(buffer.sample(32)), buffer.pos, buffer.table.facts]


def use_records(records: Records) -> Any:
    records.views()["reward"][0, 0] += 1.0
    before = records.take(np.arange(6)).copy()
    return [before, records.array.ctypes.data % 64]


def records() -> Records:
    made = Records(3, 2, {"observation": (5,), "reward": ()})
    made.array[:] = np.arange(made.array.size).reshape(made.array.shape)
    return made


def episode_table() -> EpisodeTable:
    table = EpisodeTable()
    for start in range(5):
        table.insert(10 * start, 0, 10 - start, float(start))
    return table


def use_table(table: EpisodeTable) -> Any:
    drawn = table.draw(50, np.random.default_rng(0), by_priority=True)
    table.remove(table.row_of(40, 0))
    return [drawn, table.draw(50, np.random.default_rng(1)), table.insert(40, 0, 3, 1.0)]


def use_camera(camera: Camera) -> Any:
    return camera.take({"a": np.arange(5.0)}).arrays["0"].copy()


def used_camera() -> Camera:
    camera = Camera()
    camera.take({"a": np.zeros(5)})
    return camera


def trained(**options: Any) -> HerDDPG:
    model = make_model(2, buffer_size=400, gradient_steps=3, **options)
    with redirect_stdout(io.StringIO()):
        model.learn(60, log_interval=None)  # type: ignore[arg-type]
    return model


def use_model(model: HerDDPG) -> Any:
    # Where it stops is the end of an episode; what an SB3 algorithm draws globally is seeded.
    with redirect_stdout(io.StringIO()):
        model.learn(40, log_interval=None, reset_num_timesteps=False)  # type: ignore[arg-type]
    assert model.replay_buffer is not None
    table = model.replay_buffer.table.facts
    return [weights(model).numpy().copy(), model.num_timesteps, model.replay_buffer.pos, table]


def imagining_model() -> tuple[HerDDPG, Any]:
    """A model and the callback that tests its curriculum, after a training."""
    curriculum, predictor = toy.curriculum(threshold=0.0), toy.StraightPredictor()
    env, test_env = (
        ImaginedGoalVecEnv(DummyVecEnv([toy.PointEnv] * 2), predictor, curriculum, mode)
        for mode in ("train", "test")
    )
    test_env.seed(2)
    callback = CurriculumCallback(test_env)
    model = HerDDPG(
        "MultiInputPolicy",
        env,
        gamma=0.9,
        train_freq=toy.HORIZON,
        batch_size=16,
        gradient_steps=2,
        buffer_size=400,
        policy_kwargs={"net_arch": [16]},
        seed=0,
    )
    model.learn(80, callback, log_interval=None)  # type: ignore[arg-type]
    return model, callback


def use_imagining_model(pair: tuple[HerDDPG, CurriculumCallback]) -> Any:
    model, callback = pair
    model.learn(80, callback, log_interval=None, reset_num_timesteps=False)  # type: ignore[arg-type]
    return [
        weights(model).numpy().copy(),
        callback.curriculum.k_max,
        callback.test_steps,
        model.replay_buffer.pos,  # type: ignore[union-attr]
    ]


def reaching_single() -> gym.Env:
    env = ReachFirstWrapper(gym.make(REACH_TOY), **REACH)
    env.set_reach(StraightActor(), 0.7)
    return env


def reaching_batch() -> ReachFirstVecEnv:
    env = ReachFirstVecEnv(imagined_batch(1))
    env.set_reach(StraightActor(), 0.7)
    return env


def reaching_model() -> tuple[HerDDPG, Any]:
    """A model that trains where something reaches first, and the callback that teaches it."""
    env = ReachFirstVecEnv(DummyVecEnv([lambda: gym.make(REACH_TOY)] * 2), **REACH)
    tiny = {"train_freq": 20, "batch_size": 16, "gradient_steps": 2, "buffer_size": 800}
    model = HerDDPG("MultiInputPolicy", env, **tiny, policy_kwargs={"net_arch": [16]}, seed=0)
    callback = ReachCallback(seed=0, share=0.7, n_updates=2, batch_size=16)
    model.learn(80, callback, log_interval=None)  # type: ignore[arg-type]
    return model, callback


def use_reaching_model(pair: tuple[HerDDPG, ReachCallback]) -> Any:
    model, callback = pair
    model.learn(80, callback, log_interval=None, reset_num_timesteps=False)  # type: ignore[arg-type]
    assert callback.policy is not None
    return [weights(model).numpy().copy(), use_reach_policy(callback.policy)]


def taught_reach_policy() -> ReachPolicy:
    policy = reaching_model()[1].policy
    assert policy is not None
    return policy


def use_reach_policy(policy: ReachPolicy) -> Any:
    env = DummyVecEnv([lambda: gym.make(REACH_TOY)] * 2)
    env.seed(0)
    buffer = make_buffer(env, 200)
    fill([buffer], env, 40)
    policy.learn(buffer, 2, 16)
    return [policy.moments.mean.copy(), use_reach_actor(policy.actor())]


def use_reach_actor(actor: ReachActor) -> Any:
    return [actor(np.full((2, 6), 0.3, np.float32), np.full((2, 3), 0.2, np.float32)), actor.idle]


def evaluated_model() -> tuple[HerDDPG, Any]:
    model = trained()
    eval_env = DummyVecEnv([toy.PointEnv] * 2)
    callback = OriginalGoalEvalCallback(eval_env, 2, every_steps=20, seed=0)
    model.learn(20, callback, log_interval=None, reset_num_timesteps=False)  # type: ignore[arg-type]
    return model, callback


def use_evaluated_model(pair: tuple[HerDDPG, OriginalGoalEvalCallback]) -> Any:
    model, callback = pair
    model.learn(40, callback, log_interval=None, reset_num_timesteps=False)  # type: ignore[arg-type]
    assert 0.0 < callback.wall_s < 3600.0
    return [callback.success_rate, callback.n_evaluations, weights(model).numpy().copy()]


def use_policy(policy: Any) -> Any:
    obs = {name: np.full((4, 3), 0.1, np.float32) for name in policy.observation_space}
    actions = policy.predict(obs)[0]
    loss = sum(parameter.square().sum() for parameter in policy.actor.parameters())
    policy.actor.optimizer.zero_grad()
    loss.backward()
    policy.actor.optimizer.step()
    policy.update_average(0.5)
    return [actions, policy.predict(obs)[0]]


def use_networks(networks: Any) -> Any:
    states, goals = th.full((3, 12), 0.2), th.full((3, 3), 0.3)
    return [networks.act(states, goals).numpy(), networks.infer(states, states, goals).numpy()]


def use_auxiliary(critic: Any) -> Any:
    rng = th.Generator().manual_seed(0)
    features, actions = (th.rand(8, n, generator=rng) for n in (6, 3))
    batch = Transitions({}, actions, {}, features, features)
    critic_in = th.cat([features, actions], dim=1)
    critic.update(batch, critic_in, critic_in, th.zeros(8, 1))
    return [critic.take_log(), critic.value(critic_in).item()]


def use_device_replay(replay: Any) -> Any:
    samples, steps = replay.sample_with_steps(32)
    replay._records[0] += 1.0  # what the next refresh would do
    return [as_arrays(samples), steps.numpy(), replay._records[0].numpy().copy()]


def refreshed_device_replay() -> Any:
    model = trained(replay_on_device=True)
    return model._device_replay


def follow_object() -> FollowObject:
    paths, goals = toy.paths(8)
    longer = np.concatenate([paths, np.repeat(paths[:, -1:], 40, axis=1)], axis=1)
    facts = {"env_id": PUSH, "physics": physics_id(PUSH)}
    predictor = GoalPredictor.fit(longer, goals, hidden=[8], epochs=1, **facts)  # type: ignore[arg-type]
    run = bare_run(
        PUSH,
        predictor=predictor,
        n_envs=2,
        n_threads=2,
        algorithm={
            "batch_size": 16,
            "gradient_steps": 2,
            "buffer_size": 1000,
            "policy_kwargs": {"net_arch": [8]},
        },
        curriculum={"threshold": 0.0},
    )
    return run.learn(200)


def use_follow_object(run: FollowObject) -> Any:
    run.learn(run.env_steps + 100)
    assert run.model is not None
    return [weights(run.model).numpy().copy(), run.env_steps, run.curriculum.k_max]


THINGS: dict[str, tuple[Make, Use]] = {
    "FetchEnv": (lambda: begun_single(gym.make(ROBOT).unwrapped), play_single),
    "ObjectEnv": (lambda: begun_single(gym.make(OBJECT).unwrapped), play_single),
    "wrapped FetchEnv": (lambda: begun_single(gym.make(ROBOT)), play_single),
    "FetchVecEnv, 1 thread": (lambda: begun_batch(make_vec(ROBOT, 3, 1)), play_batch),
    "FetchVecEnv, 2 threads": (lambda: begun_batch(make_vec(ROBOT, 3, 2)), play_batch),
    "FetchVecEnv, blocked": (lambda: begun_batch(make_vec(PUSH, 2, 1)), play_batch),
    "ObjectVecEnv, 1 thread": (lambda: begun_batch(make_vec(OBJECT, 3, 1)), play_batch),
    "ObjectVecEnv, 2 threads": (
        lambda: begun_batch(make_vec(OBJECT, 3, 2, on_table=True, reward_type="dense")),
        play_batch,
    ),
    "ImaginedGoalWrapper": (
        lambda: begun_single(imagined_single(gym.make(ROBOT), 50)),
        play_single,
    ),
    "DummyVecEnv": (
        lambda: begun_batch(DummyVecEnv([lambda: imagined_single(gym.make(ROBOT), 50)] * 2)),
        play_batch,
    ),
    "ImaginedGoalVecEnv, 1 thread": (lambda: begun_batch(imagined_batch(1)), play_batch),
    "ImaginedGoalVecEnv, 2 threads": (lambda: begun_batch(imagined_batch(2)), play_batch),
    "VecMonitor": (lambda: begun_batch(VecMonitor(imagined_batch(2))), play_batch),
    "VecFrameStack": (lambda: begun_batch(VecFrameStack(imagined_batch(1), 2)), play_batch),
    "ReachFirstWrapper": (lambda: begun_single(reaching_single()), play_single),
    "ReachFirstVecEnv": (lambda: begun_batch(reaching_batch()), play_batch),
    "ReachPolicy": (taught_reach_policy, use_reach_policy),
    "ReachActor": (lambda: taught_reach_policy().actor(), use_reach_actor),
    "ReachCallback": (reaching_model, use_reaching_model),
    "GoalPredictor": (fitted_predictor, use_predictor),
    "Curriculum": (lambda: toy.curriculum(k_max=3), use_curriculum),
    "FollowObjectReplayBuffer": (filled_buffer, use_buffer),
    "FollowObjectReplayBuffer with all": (
        lambda: filled_buffer(
            moved_ratio=0.5, min_goal_distance=0.05, scene_distance=0.05, cher={}
        ),
        use_buffer,
    ),
    "Records": (records, use_records),
    "EpisodeTable": (episode_table, use_table),
    "DeviceReplay": (refreshed_device_replay, use_device_replay),
    "Camera": (used_camera, use_camera),
    "HerDDPG": (trained, use_model),
    "HerDDPG that prints": (lambda: trained(verbose=1), use_model),
    "HerDDPG, replay on the device": (lambda: trained(replay_on_device=True), use_model),
    "HerDDPG with an auxiliary reward": (
        lambda: trained(auxiliary={"name": "rnd", "hidden": [8], "n_outputs": 4}),
        use_model,
    ),
    "HerPolicy": (lambda: trained().policy, use_policy),
    "AuxiliaryCritic": (
        lambda: trained(auxiliary={"name": "rnd", "hidden": [8]}).auxiliary_critic,
        use_auxiliary,
    ),
    "ObjectNetworks": (lambda: seeded(tiny_networks), use_networks),
    "CurriculumCallback": (imagining_model, use_imagining_model),
    "OriginalGoalEvalCallback": (evaluated_model, use_evaluated_model),
    "FollowObject": (follow_object, use_follow_object),
}


def seeded(use: Callable[..., Any], *arguments: Any) -> Any:
    """Call with the global generators where they always are."""
    np.random.seed(0)
    th.manual_seed(0)
    return use(*arguments)
