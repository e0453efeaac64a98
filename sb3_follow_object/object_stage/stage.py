"""Stages one and two: the object alone learns the way, and F_phi learns to imagine it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from ..any_task.tasks import (
    SURFACE_STEPS,
    context_of_task,
    object_vec_env,
    physics_of_task,
    surface_choices,
    what_is_followed,
)
from ..common.reports import Report
from ..common.seeds import stream_seed
from ..ddpg.her_ddpg import HerDDPG
from ..envs import IDS
from ..imagination.goal_predictor import GoalPredictor
from ..imagination.predictor_files import without_module
from .networks import ObjectNetworks, check_readable
from .policy import ObjectProgress, StopWhenSolved, collect_paths, train_object_policy


class ObjectStage:
    """What a task's object learns alone (paper, sections 4.1 and 4.2).

    Args:
        settings: `FollowObject`'s; env_id, seed, object_*, *_fit, n_paths and n_threads are read.
        report: called with a sentence as it goes on.
        needs_networks: whether SLDR's reward will read the object's networks.

    Attributes:
        predictor: F_phi, once it is learned or given.
        networks: what SLDR's reward reads, once that is.
        steps: env steps that both stages cost.
        policy_steps: those of the object policy alone, where it was learned here.
        success: share of the object's last noise-free episodes that ended on their goal.
        on_table: whether the object may not leave the surface; decided once it has learned.
    """

    def __init__(
        self,
        settings: Mapping[str, Any],
        report: Report,
        needs_networks: bool,
    ):
        self.settings = settings
        self.env_id: str = settings["env_id"]
        self.seed: int = settings["seed"]
        self.report = report
        self.needs_networks = needs_networks
        self.predictor: GoalPredictor | None = None
        self.networks: ObjectNetworks | None = None
        self.steps = self.policy_steps = 0
        self.success = float("nan")
        self.on_table: bool | None = None

    def use_predictor(self, predictor: GoalPredictor) -> None:
        """Take an F_phi that was made before.

        Raises:
            ValueError: it was made for another task, for other physics, or from an object that
                was kept on the table where this one's is not, or the other way round.
        """
        task, physics = without_module(self.env_id), physics_of_task(self.env_id)
        if (predictor.env_id, predictor.physics) != (task, physics):
            raise ValueError(
                f"the predictor was made for {predictor.env_id} (physics {predictor.physics}), "
                f"not for {task} (physics {physics}); make a new one"
            )
        choices = self._choices()
        if predictor.object_on_table not in (None, *choices):
            raise ValueError(
                f"the predictor was made with object_on_table={predictor.object_on_table}, "
                f"not {choices[0]}; make a new one"
            )
        self.on_table = predictor.object_on_table
        self.predictor = predictor

    def use_networks(self, networks: ObjectNetworks) -> None:
        """Take networks that were made before.

        Raises:
            ValueError: they were made for another task or for other physics.
        """
        networks.check(self.env_id, physics_of_task(self.env_id), "the object_networks given")
        self.networks = networks

    def learn_policy(
        self,
        callback: Callable[[StopWhenSolved], BaseCallback] | None = None,
        state: dict[str, Any] | None = None,
        between_epochs: Callable[[], None] = lambda: None,
        networks: bool = False,
    ) -> None:
        """Run stage one (section 4.1): the object policy, and with SLDR the networks that it needs.

        Args:
            callback: makes a callback from the one that tests the object's policy.
            state: of that one; stage one goes on exactly from there.
            between_epochs: called while the inverse model is fitted; may raise to stop.
            networks: whether to make what SLDR needs for others, though this run does not, where
                they can read it.
        """
        model, _ = self._learn(callback, state, between_epochs, False)
        self._make_networks(model, between_epochs, networks)

    def learn_predictor(
        self,
        callback: Callable[[StopWhenSolved], BaseCallback] | None = None,
        state: dict[str, Any] | None = None,
        between_epochs: Callable[[], None] = lambda: None,
        networks: bool = False,
        keep: Callable[[GoalPredictor], None] = lambda predictor: None,
    ) -> GoalPredictor:
        """Run both stages: object policy, then F_phi (sections 4.1 and 4.2).

        Args:
            callback: as in `learn_policy`.
            state: as in `learn_policy`.
            between_epochs: called while F_phi and the inverse model are fitted; may raise to stop.
            networks: as in `learn_policy`.
            keep: called with F_phi, before SLDR's networks are made.
        """
        model, self.predictor = self._learn(callback, state, between_epochs, True)
        assert self.predictor is not None
        keep(self.predictor)
        self._make_networks(model, between_epochs, networks)
        return self.predictor

    def _learn(
        self,
        callback: Callable[[StopWhenSolved], BaseCallback] | None,
        state: dict[str, Any] | None,
        between_epochs: Callable[[], None],
        predicted: bool,
    ) -> tuple[HerDDPG, GoalPredictor | None]:
        """Train the object's policy, as long again where F_phi is off by more than `object_error`.

        A policy can reach every goal by ways that are detours and change abruptly from one goal to
        the next. F_phi's error tells; with twice the steps they straighten. The paths that tell are
        counted as the policy's, so SLDR alone counts what it does with F_phi beside it.

        Returns:
            The algorithm, and F_phi where it is wanted or was made to judge by.
        """
        self.report(f"stage 1: the object of {self.env_id} learns to move by itself")
        if sentence := what_is_followed(self.env_id):
            self.report(f"  {sentence}")
        made: GoalPredictor | None = None

        def too_rough(model: HerDDPG, solved: StopWhenSolved) -> bool:
            nonlocal made
            made, path_steps = self._predict(model, solved, between_epochs)
            self.policy_steps = self.steps
            if float(np.mean(made.error_mm)) <= 1000.0 * self.settings["object_error"]:
                return False
            made = None
            solved.progress = replace(solved.progress, paths=path_steps)
            steps = min(2 * model.num_timesteps, self.settings["object_timesteps"])
            self.report(f"  its ways are too rough: the object learns on, for {steps} steps in all")
            return True

        judged = self.settings["object_error"] > 0.0
        model, solved = self._train(callback, state, too_rough if judged else None)
        if made is None and predicted:
            made, _ = self._predict(model, solved, between_epochs)
        elif made is None:
            self._count(model, solved)
        return model, made

    def _count(self, model: HerDDPG, solved: StopWhenSolved) -> None:
        """Note what the policy has cost, and what its last test came to."""
        self.steps = self.policy_steps = solved.progress.earlier_steps + model.num_timesteps
        self.success = solved.rates[-1] if solved.rates else float("nan")

    def _predict(
        self, model: HerDDPG, solved: StopWhenSolved, between_epochs: Callable[[], None]
    ) -> tuple[GoalPredictor, int]:
        """Fit F_phi to noise-free paths; return it and the env steps that they took."""
        settings = self.settings
        self._count(model, solved)
        env = self._env("paths")
        paths = collect_paths(model, env, settings["n_paths"])
        env.close()
        self.steps += paths.env_steps
        self.success = paths.success_rate
        self.report(
            f"  {self.steps} env steps, noise-free success {paths.success_rate:.2f}"
            + ("" if solved.solved else " (not solved: its imagined goals may mislead)")
        )
        self.report("stage 2: F_phi learns to imagine goals")
        predictor = GoalPredictor.fit(
            paths.positions,
            paths.goals,
            env_id=self.env_id,
            physics=physics_of_task(self.env_id),
            object_on_table=self.on_table,
            context=context_of_task(self.env_id),
            contexts=paths.contexts,
            seed=stream_seed(self.seed, "predictor"),
            progress=lambda epoch, loss: between_epochs(),
            **{"device": str(model.device), **settings["predictor_fit"]},
        )
        self.report(f"  held-out error {float(np.mean(predictor.error_mm)):.1f} mm")
        return predictor, paths.env_steps

    def _make_networks(
        self, model: HerDDPG, between_epochs: Callable[[], None], asked: bool
    ) -> None:
        """Make what SLDR's reward reads, where it will be read; if others ask, where it can be."""
        if not self.needs_networks:
            if not asked or self.env_id not in IDS:
                return
            try:
                check_readable(model.policy)
            except ValueError as refusal:
                self.report(f"  the object's networks are left out: {refusal}")
                return
        self.networks = ObjectNetworks.learned(
            model,
            self.env_id,
            physics_of_task(self.env_id),
            seed=stream_seed(self.seed, "inverse"),
            between_updates=between_epochs,
            **self.settings["inverse_fit"],
        )
        error = self.networks.inverse_error
        self.report(f"  {self.steps} env steps, inverse model's error {error:.3f}")

    def _choices(self) -> tuple[bool, ...]:
        """Whether the object stays on its surface, in the order of trial."""
        return surface_choices(self.env_id, self.settings["object_on_table"])

    def _train(
        self,
        callback: Callable[[StopWhenSolved], BaseCallback] | None,
        state: dict[str, Any] | None,
        too_rough: Callable[[HerDDPG, StopWhenSolved], bool] | None,
    ) -> tuple[HerDDPG, StopWhenSolved]:
        """Train the object's policy, off its surface once it does not learn on it."""
        settings, choices = self.settings, self._choices()
        if settings["object_timesteps"] <= SURFACE_STEPS:
            choices = choices[:1]  # too few to tell
        progress = ObjectProgress(**(state or {}).get("notes", {}))
        while True:
            self.on_table = choices[progress.trial]
            last = progress.trial == len(choices) - 1
            env, test_env = (self._env(name) for name in ("object", "object_test"))
            model, solved = train_object_policy(
                env,
                test_env,
                settings["object_timesteps"],
                give_up_after=None if last else SURFACE_STEPS,
                n_test_episodes=settings["object_test_episodes"],
                test_every=settings["object_test_every"],
                success_rate=settings["object_success"],
                seed=stream_seed(self.seed, "object"),
                report=lambda steps, rate: self.report(f"  {steps:>7} steps: success {rate:.2f}"),
                callback=callback,
                progress=progress,
                state=state,
                too_rough=too_rough,
                **settings["object_algorithm"],
            )
            env.close()
            test_env.close()
            # What learned on, as its ways were rough, was solved, whatever its last tests say.
            if solved.solved or solved.learns_on or last:
                return model, solved
            progress = ObjectProgress(progress.trial + 1, progress.spent + model.num_timesteps)
            state = None
            self.report("  it does not learn on its surface: it may leave it from here on")

    def _env(self, purpose: str) -> VecEnv:
        env = object_vec_env(
            self.env_id,
            self.settings["object_n_envs"],
            self.settings["n_threads"],
            on_table=bool(self.on_table),
        )
        env.seed(stream_seed(self.seed, purpose))
        return env
