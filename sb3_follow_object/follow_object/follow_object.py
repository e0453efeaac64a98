"""Follow the Object: the three stages of the paper behind one `learn()`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.vec_env import VecEnv

from ..any_task.registering import MakeEnv, made_by_function, registered
from ..callbacks.curriculum_callback import CurriculumCallback
from ..callbacks.reach_callback import ReachCallback
from ..common.numbers import checked_whole, shown
from ..common.reports import Report
from ..common.torch_helpers import threads_at
from ..ddpg.actor_files import save_actor
from ..ddpg.her_ddpg import HerDDPG
from ..envs.goal_envs import known_id
from ..envs.robot_face import EffectorOf, GoalOf, Judge
from ..imagination.curriculum import Curriculum
from ..imagination.goal_predictor import GoalPredictor
from ..imagination.predictor_files import without_module
from ..object_stage.networks import FILE as OBJECT_FILE
from ..object_stage.networks import ObjectNetworks
from ..object_stage.sldr import reads_object_networks
from ..object_stage.stage import ObjectStage
from ..settings.fields import check_names
from ..settings.run_config import check_plain
from .checks import check_algorithms
from .given_settings import check_places, run_settings
from .robot_stage import RobotStage
from .saved_folder import Saved, differing, face_of, read, saved_id, write

_OF_AN_ENVIRONMENT = ("env_id", "make_env", "object", "goal", "is_success", "effector")


class FollowObject:
    """Teach a robot a far goal by letting the object find the way first.

    `learn()` runs the three stages of the paper (section 4): the object alone learns to reach the
    goal; its paths train F_phi; the robot trains on original goals and on the goals that F_phi
    imagines at growing distance. It has the settings that `sb3-follow-object train` takes for the
    task, unless they are given otherwise.

    Args:
        env_id: a task of this package, e.g. "FollowObject/PnPShelf-v0", or any goal environment on
            MuJoCo that gymnasium knows, e.g. "FetchPickAndPlace-v4".
        method: one of `METHODS`; None, "fo", or what the settings given make of it.
        preset: "default", what was measured to be best, or "paper", the authors' settings; None,
            each setting's own default, which are the plain method's.
        make_env: in place of an id, a function that makes such an environment.
        object: name of the body that the goals are about; by default it is found.
        goal: for environments without goals, a function of (env, observation) that returns the
            achieved and the desired position, (3,) metres each.
        is_success: likewise of (achieved, desired): whether the goal is reached.
        effector: likewise of (env): position of what touches the object, (3,) metres, where the
            observation does not hold it; is told at the observation's end. `fingertips` reads it
            from any simulation.
        lift: whether the object may leave its surface in the first stage; "auto" decides by the
            heights of the goals, and by whether the object learns. The opposite of
            `object_on_table`.
        predictor: an F_phi made before for this task; skips the first two stages.
        object_networks: of an object stage made before for this task; needed beside `predictor`
            where `algorithm` has the auxiliary reward "sldr", which reads them.
        seed: decides the whole run.
        report: called with a sentence as stages begin and end.
        **settings: of the three stages, as `sb3-follow-object settings` lists them, e.g. n_envs=8,
            reach=None, curriculum={"p": 0.5}, algorithm={"batch_size": 256}, which is the robot's
            `HerDDPG`; what a mapping leaves out stays the preset's.

    Attributes:
        object_stage: the first two stages, what they learned and what they cost.
        robot_stage: the third.

    Raises:
        ValueError: an unknown task, method, preset or setting, with the nearest known one; a
            predictor made for another task, or a value out of range.
    """

    def __init__(
        self,
        env_id: str | None = None,
        *,
        method: str | None = None,
        preset: str | None = "default",
        make_env: MakeEnv | None = None,
        object: str | None = None,
        goal: GoalOf | None = None,
        is_success: Judge | None = None,
        effector: EffectorOf | None = None,
        lift: bool | Literal["auto"] = "auto",
        predictor: GoalPredictor | None = None,
        object_networks: ObjectNetworks | None = None,
        seed: int = 0,
        report: Report | None = None,
        **settings: Any,
    ):
        check_places(settings, preset)
        for name, thing, kind in (
            ("predictor", predictor, GoalPredictor),
            ("object_networks", object_networks, ObjectNetworks),
        ):
            if thing is not None and not isinstance(thing, kind):
                raise ValueError(
                    f"{name} must be of the class {kind.__name__}, not {shown(thing)}; "
                    f"get_{name} makes or loads one"
                )
        if report is not None and not callable(report):
            raise ValueError(f"report must be a function of a sentence, not {shown(report)}")
        full_id = registered(
            env_id,
            make_env=make_env,
            object=object,
            goal=goal,
            is_success=is_success,
            effector=effector,
        )
        self.report = report or _say_nothing
        self.settings = run_settings(full_id, method, preset, settings, lift, seed, self.report)
        self.env_id: str = self.settings["env_id"]
        self.full_id = full_id  # with the module that registers it, as given
        self.imagine: bool = self.settings["imagine"]
        self.seed: int = self.settings["seed"]
        self.object_stage = ObjectStage(
            self.settings,
            self.report,
            needs_networks=reads_object_networks(self.settings["algorithm"]),
        )
        self._take(predictor, object_networks, lift)
        self.robot_stage = RobotStage(self.settings)
        self._checked = False

    def _take(
        self,
        predictor: GoalPredictor | None,
        networks: ObjectNetworks | None,
        lift: bool | Literal["auto"],
    ) -> None:
        """Take what an object stage made before, or refuse what none here would read."""
        given = {
            "predictor": predictor is not None and not self.imagine,
            "object_networks": networks is not None and not self.object_stage.needs_networks,
            "lift": lift != "auto" and not self.has_object_stage,
        }
        if unread := [name for name, is_unread in given.items() if is_unread]:
            raise ValueError(f"nothing of this method reads {' and '.join(unread)}; leave it out")
        both = self.imagine and self.object_stage.needs_networks
        if both and (predictor is None) != (networks is None):
            raise ValueError(
                "the auxiliary reward 'sldr' needs the object's networks beside the predictor; "
                f"give those of the same object stage ({OBJECT_FILE}), or neither"
            )
        if predictor is not None:
            self.object_stage.use_predictor(predictor)
        if networks is not None:
            self.object_stage.use_networks(networks)

    @property
    def has_object_stage(self) -> bool:
        """Whether the object learns first, for imagined goals or for SLDR."""
        return self.imagine or self.object_stage.needs_networks

    @property
    def predictor(self) -> GoalPredictor | None:
        """F_phi, once the second stage has ended."""
        return self.object_stage.predictor

    @property
    def object_steps(self) -> int:
        """Env steps that the first two stages cost."""
        return self.object_stage.steps

    @property
    def env(self) -> VecEnv:
        """The copies of the task that the robot trains in."""
        return self.robot_stage.env

    @property
    def horizon(self) -> int:
        """T, steps of an episode."""
        return self.robot_stage.horizon

    @property
    def curriculum(self) -> Curriculum:
        """How far the imagined goals lie."""
        return self.robot_stage.curriculum

    @property
    def model(self) -> HerDDPG | None:
        """The robot's algorithm, once the third stage has begun."""
        return self.robot_stage.model

    @property
    def curriculum_callback(self) -> CurriculumCallback | None:
        """What tests k_max, once the third stage has begun; None without imagined goals."""
        return self.robot_stage.curriculum_callback

    @property
    def reach_callback(self) -> ReachCallback | None:
        """What learns to reach, once the third stage has begun; None without `reach`."""
        return self.robot_stage.reach_callback

    @property
    def env_steps(self) -> int:
        """Env steps so far: the object's, the robot's and those of the curriculum's tests."""
        return self.object_steps + (self.model.num_timesteps if self.model else 0)

    @property
    def test_steps(self) -> int:
        """Env steps of the curriculum's tests, part of `env_steps`."""
        return self.curriculum_callback.test_steps if self.curriculum_callback else 0

    def check(self) -> None:
        """Raise a ValueError for a setting that a later stage would fail on."""
        if not self._checked:
            check_algorithms(
                self.settings, self.env, self.horizon, self.object_stage.needs_networks
            )
            self._checked = True

    def prepare(self) -> HerDDPG:
        """Run the stages that are missing before the robot can train; build its algorithm."""
        if self.model is not None:
            return self.model
        self.check()
        stage = self.object_stage
        with threads_at(1):
            if self.imagine and stage.predictor is None:
                stage.learn_predictor()
            if stage.needs_networks and stage.networks is None:
                stage.learn_policy()
        return self.robot_stage.begin(
            stage.predictor if self.imagine else None,
            stage.networks if stage.needs_networks else None,
            stage.on_table,
        )

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = None,
        tb_log_name: str = "FollowObject",
        progress_bar: bool = False,
    ) -> FollowObject:
        """Train until `env_steps` reaches `total_timesteps`; may be called again with more.

        The object's stage comes first and runs to its own end, however few `total_timesteps` are.
        PyTorch has one thread meanwhile, which is fastest beside other work;
        `algorithm={"update_threads": 2}` gives gradient steps more.

        Args:
            total_timesteps: env steps in all, object stage, tests and earlier calls included.
            callback: of SB3, called while the robot trains.
            log_interval: episodes between two log lines of SB3; None, one a rollout where
                `algorithm` has `verbose` or `tensorboard_log`.
            tb_log_name: of the training in `tensorboard_log`, as SB3's.
            progress_bar: SB3's, of the robot's training.

        Raises:
            ValueError: total_timesteps is no whole number of at least 0, log_interval none of at
                least 1, or something else than a callback is given as one.
        """
        total_timesteps = checked_whole("total_timesteps", total_timesteps, 0)
        if log_interval is not None:
            log_interval = checked_whole("log_interval", log_interval, 1)
        for each in callback if isinstance(callback, list) else [callback]:
            if not (each is None or isinstance(each, BaseCallback) or callable(each)):
                raise ValueError(
                    f"callback must be SB3's, a function, or a list of these, not {shown(each)}"
                )
        self.prepare()
        remaining = total_timesteps - self.env_steps
        if remaining > 0:
            with threads_at(1):
                self.robot_stage.learn(remaining, callback, log_interval, tb_log_name, progress_bar)
        elif self.env_steps == self.object_steps >= total_timesteps > 0:
            self.report(
                f"the object's stage took {self.object_steps:,} env steps of {total_timesteps:,}: "
                "none were left for the robot"
            )
        elif total_timesteps > 0:
            self.report(
                f"{self.env_steps:,} env steps are done already, of {total_timesteps:,} in all: "
                "none are left"
            )
        return self

    def predict(
        self,
        observation: dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Return the robot's actions and `state`; SB3's `evaluate_policy` takes it too.

        Args:
            observation: of one environment, or of a VecEnv's copies.
            state: of a recurrent policy, which this is not.
            episode_start: likewise.
            deterministic: makes no difference: the policy itself has no noise.
        """
        if self.model is None:
            raise ValueError("nothing has been learned yet: call learn() first")
        return self.model.predict(observation, state, episode_start, deterministic)

    # ---- saving -------------------------------------------------------------------------------

    def state_dict(self, replay_buffer: bool = True) -> dict[str, Any]:
        """Return what `learn` has changed, at an episode's end of every copy.

        It holds the tensors that training changes: keep a `copy.deepcopy` to come back to it.
        """
        return {
            "object_steps": self.object_steps,
            "object_success": self.object_stage.success,
            **self.robot_stage.state_dict(replay_buffer),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict`; the predictor must have been given already."""
        self.object_stage.steps = state["object_steps"]
        self.object_stage.success = state["object_success"]
        if "model" in state:
            self.prepare()
        self.robot_stage.load_state_dict(state)

    def save(self, folder: str | os.PathLike[str], replay_buffer: bool = True) -> None:
        """Save everything to a folder: settings, predictor and training state.

        Args:
            folder: is created; files of an earlier save are replaced.
            replay_buffer: False makes a small save that can act and train on, from empty replay.

        Raises:
            ValueError: a setting is a Python object, which a save does not hold.
        """
        check_plain(self.settings, "save()")
        settings = {**self.settings, "env_id": self.full_id}
        stage, state = self.object_stage, self.state_dict(replay_buffer)
        face = face_of(self.env_id) if made_by_function(self.env_id) else None
        write(Path(folder), Saved(settings, stage.predictor, stage.networks, state, face))

    @classmethod
    def load(
        cls, folder: str | os.PathLike[str], report: Report | None = None, **environment: Any
    ) -> FollowObject:
        """Restore what `save` wrote; training goes on exactly where it stopped.

        Args:
            folder: that `save` was given.
            report: as of the class.
            **environment: env_id, make_env, object, goal, is_success and effector as they were
                given, where an id alone did not say it.

        Raises:
            ValueError: the folder holds no save, a damaged one, or one of another environment.
        """
        folder = Path(folder)
        try:
            env_id = saved_id(folder)
        except (OSError, KeyError, RecursionError, TypeError, ValueError) as error:
            raise ValueError(f"{folder} holds no saved FollowObject ({error})") from error
        check_names(environment, _OF_AN_ENVIRONMENT, "load()")
        if environment and not made_by_function(env_id):
            other = known_id(environment.pop("env_id", env_id))
            if environment or without_module(other) != without_module(env_id):
                raise ValueError(f"{folder} is of {env_id}; load() can make it of no other one")
        elif environment:
            registered(**environment, named=env_id)
        if made_by_function(env_id) and env_id not in gym.registry:
            raise ValueError(
                f"{folder} is of an environment that came with functions: give load() make_env= "
                "and what else FollowObject was given of it"
            )
        try:
            saved = read(folder)
            face = face_of(env_id) if made_by_function(env_id) else None
            if face is not None and saved.face not in (None, face):
                raise ValueError(f"it is of another environment: {differing(saved.face, face)}")
            run = cls(
                preset=None,
                **saved.settings,
                predictor=saved.predictor,
                object_networks=saved.object_networks,
                report=report,
            )
            run.load_state_dict(saved.state)
            return run
        except (OSError, KeyError, RecursionError, TypeError, ValueError) as error:
            raise ValueError(f"{folder} holds no saved FollowObject ({error})") from error

    def save_policy(self, path: str | os.PathLike[str]) -> None:
        """Save the actor that `predict` uses alone: a small file that `load_actor` reads."""
        if self.model is None:
            raise ValueError("nothing has been learned yet: call learn() first")
        save_actor(path, self.model.policy.actor_average, self.env_id)

    def close(self) -> None:
        """Close all environments."""
        self.robot_stage.close()


def _say_nothing(sentence: str) -> None:
    """Report to nobody."""
