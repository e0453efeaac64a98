"""The third stage: the robot's environment, the goals imagined in it, its algorithm."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.vec_env import VecEnv

from ..any_task.tasks import steps_of_object
from ..callbacks.curriculum_callback import CurriculumCallback
from ..callbacks.fresh_episodes import FreshEpisodes, begin_new_episodes
from ..callbacks.progress_bar import WholeProgressBar
from ..callbacks.reach_callback import ReachCallback
from ..common.resuming import env_state, global_generators, set_env_state, set_global_generators
from ..common.seeds import stream_seed
from ..ddpg.her_ddpg import HerDDPG
from ..envs import IDS
from ..envs.goal_envs import SAY_LENGTH, check_goal_keys, episode_steps
from ..envs.robot_copies import robot_vec_env
from ..imagination.curriculum import Curriculum
from ..imagination.goal_predictor import GoalPredictor
from ..imagination.vec_env import ImaginedGoalVecEnv
from ..object_stage.networks import ObjectNetworks
from ..reach.vec_env import ReachFirstVecEnv
from .checks import reach_parts


class RobotStage:
    """Trains the robot on original goals and on imagined ones (paper, section 4.3).

    Args:
        settings: `FollowObject`'s, with env_id and seed.

    Attributes:
        env: the copies that the robot trains in; goals are imagined in them from `begin` on.
        horizon: T, steps of an episode.
        curriculum: how far the imagined goals lie.
        model: the robot's algorithm, from `begin` on.
        curriculum_callback: tests k_max, from `begin` on; None without imagined goals.
        reach_callback: learns to reach, from `begin` on; None where nothing reaches first.
    """

    def __init__(self, settings: Mapping[str, Any]):
        self._settings = settings
        self._seed: int = settings["seed"]
        self.env = self._copies("robot")
        try:
            self.horizon = self._episode_steps()
            steps = steps_of_object(settings["env_id"], self.horizon)
            self.curriculum = Curriculum(steps, **settings["curriculum"])
        except BaseException:
            self.env.close()  # its processes would outlive the refusal
            raise
        self.model: HerDDPG | None = None
        self.curriculum_callback: CurriculumCallback | None = None
        self.reach_callback: ReachCallback | None = None

    def begin(
        self,
        predictor: GoalPredictor | None,
        networks: ObjectNetworks | None,
        on_table: bool | None = None,
    ) -> HerDDPG:
        """Build what trains.

        Args:
            predictor: F_phi; None imagines no goals.
            networks: the object's, which SLDR's reward reads; None where it is not used.
            on_table: whether the object's stage has kept it on its surface, where there was one.
        """
        arguments: dict[str, Any] = {"policy": "MultiInputPolicy", **self._settings["algorithm"]}
        if networks is not None:
            arguments["auxiliary"] = {**arguments["auxiliary"], "object_networks": networks}
        if predictor is not None:
            self._imagine(predictor)
        if self._settings.get("reach") is not None:
            first, teaching = reach_parts(self._settings, on_table)
            self.env = ReachFirstVecEnv(self.env, **first)
            self.reach_callback = ReachCallback(stream_seed(self._seed, "reach"), **teaching)
        self.model = HerDDPG(env=self.env, seed=stream_seed(self._seed, "networks"), **arguments)
        if predictor is not None:
            predictor.to(self.model.device)  # it imagines the goals of all copies at once
        # SB3 seeds the environment too; a run's streams are its own.
        self.env.seed(stream_seed(self._seed, "robot"))
        return self.model

    def learn(
        self,
        n_steps: int,
        callback: MaybeCallback,
        log_interval: int | None,
        tb_log_name: str,
        progress_bar: bool,
    ) -> None:
        """Train for more env steps, those of the curriculum's tests included."""
        model = self.model
        assert model is not None
        callbacks: list[BaseCallback] = []
        if env_state(self.env) is None:
            testing = self.curriculum_callback
            tests = None if testing is None else testing.test_env
            callbacks.append(FreshEpisodes(lambda n: stream_seed(self._seed, f"robot {n}"), tests))
        own = (self.reach_callback, self.curriculum_callback)
        callbacks += [each for each in own if each is not None]
        for each in callback if isinstance(callback, list) else [callback]:
            if each is not None:
                callbacks.append(each if isinstance(each, BaseCallback) else ConvertCallback(each))
        if progress_bar:
            callbacks.append(WholeProgressBar())
        shows = model.verbose > 0 or model.tensorboard_log is not None
        if log_interval is None and shows and not model._custom_logger:
            log_interval = self.env.num_envs
        model.learn(
            n_steps,
            callback=callbacks,
            log_interval=log_interval,  # type: ignore[arg-type]
            tb_log_name=tb_log_name,
            # A training that goes on writes to the log that it has, a first one to its own.
            reset_num_timesteps=model.num_timesteps == 0 and model._last_obs is None,
        )

    def state_dict(self, replay_buffer: bool = True) -> dict[str, Any]:
        """Return what `learn` has changed, at an episode's end of every copy."""
        state: dict[str, Any] = {"curriculum": self.curriculum.state_dict()}
        if self.model is None:
            return state
        state["model"] = self.model.training_state()
        state["env"] = env_state(self.env)
        state["generators"] = global_generators()
        if self.reach_callback is not None:
            state["reach"] = self.reach_callback.state_dict()
        if self.curriculum_callback is not None:
            state["callback"] = self.curriculum_callback.state_dict()
            state["test_env"] = env_state(self.curriculum_callback.test_env)
        if replay_buffer:
            assert self.model.replay_buffer is not None
            state["replay_buffer"] = self.model.replay_buffer.state_dict()
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict`; the stage must have begun where it had then."""
        self.curriculum.load_state_dict(state["curriculum"])
        if "model" not in state:
            return
        assert self.model is not None
        self.model.load_training_state(state["model"])
        set_env_state(self.env, state["env"])
        if self.reach_callback is not None:
            self.reach_callback.load_state_dict(state["reach"], self.model)
        if self.curriculum_callback is not None:
            self.curriculum_callback.load_state_dict(state["callback"])
            set_env_state(self.curriculum_callback.test_env, state["test_env"])
        if "replay_buffer" in state:
            assert self.model.replay_buffer is not None
            self.model.replay_buffer.load_state_dict(state["replay_buffer"])
        else:
            self.model.expect_new_replay()
        if state["env"] is None:
            begin_new_episodes(self.model)
        set_global_generators(state["generators"])

    def close(self) -> None:
        """Close all environments."""
        self.env.close()
        if self.curriculum_callback is not None:
            self.curriculum_callback.test_env.close()

    def _imagine(self, predictor: GoalPredictor) -> None:
        """Show imagined goals from now on, in the training and in tests at k_max."""
        self.env = ImaginedGoalVecEnv(self.env, predictor, self.curriculum)
        test_env = ImaginedGoalVecEnv(self._copies("test"), predictor, self.curriculum, mode="test")
        test_env.seed(stream_seed(self._seed, "test"))
        self.curriculum_callback = CurriculumCallback(
            test_env,
            self._settings["n_test_episodes"],
            every=self._settings["test_every"],
            store=self._settings["store_tests"],
        )

    def _episode_steps(self) -> int:
        """Return T, steps of an episode.

        Raises:
            ValueError: the environment does not say, or has no goals.
        """
        env_id: str = self._settings["env_id"]
        check_goal_keys(self.env.observation_space, repr(env_id))
        horizon = episode_steps(self.env)
        if horizon is None:
            raise ValueError(f"{env_id!r} does not say how long its episodes are; {SAY_LENGTH}")
        return horizon

    def _copies(self, purpose: str) -> VecEnv:
        """Make copies of the task, whose episodes are of the random stream of this name."""
        env_id, reward_type = self._settings["env_id"], self._settings["reward_type"]
        # Environments of others need not know the word; theirs are sparse unless asked.
        options = {"reward_type": reward_type} if env_id in IDS or reward_type != "sparse" else {}
        n_envs, n_threads = self._settings["n_envs"], self._settings["n_threads"]
        env = robot_vec_env(env_id, n_envs, n_threads, **options)
        env.seed(stream_seed(self._seed, purpose))
        return env
