"""What the object stage leaves behind for SLDR: Q_obj, nu and an inverse model."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import create_mlp, get_actor_critic_arch
from torch import nn

from ..common.array_trees import load_tree, save_tree
from ..common.numbers import checked_whole
from ..common.reports import reason
from ..common.torch_helpers import WholeModule, lowest, usual_defaults
from ..ddpg.her_ddpg import HerDDPG
from ..ddpg.policies import HerPolicy, NormalizedGoalExtractor
from ..imagination.predictor_files import CONTEXT_LIMIT, valid_hidden, without_module
from ..settings.kinds import CRITICS_LIMIT
from ..settings.learning import InverseSettings

FILE = "object_networks.safetensors"
FORMAT = 1
OBSERVATION, GOAL, ACTION = 12, 3, 7  # of the object's environment, without a context


class ObjectNetworks(WholeModule):
    """The object's critic and policy, and the action that leads from one of its states to the next.

    Made by `learned` or `load`.

    Args:
        env_id: gymnasium id of the robot's task that it was made for; a module before it is not
            kept.
        physics: short hash of the physics that it was made for.
        pi, qf, inverse: widths of the hidden layers of policy, critics and inverse model.
        n_critics: whose lowest value counts.
        layer_norm: whether the critics have LayerNorm.
        clip: of the standardised inputs.
        n_context: numbers that the object's observations end with, about other things.

    Attributes:
        inverse_error: mean squared error of the inverse model at the end of its fit; NaN before.
    """

    def __init__(
        self,
        env_id: str,
        physics: str,
        pi: Sequence[int],
        qf: Sequence[int],
        inverse: Sequence[int],
        n_critics: int = 1,
        layer_norm: bool = False,
        clip: float = 5.0,
        n_context: int = 0,
    ) -> None:
        super().__init__()
        self.env_id = without_module(env_id)
        self.physics = physics
        self.shape: dict[str, Any] = {
            "pi": list(pi),
            "qf": list(qf),
            "inverse": list(inverse),
            "n_critics": n_critics,
            "layer_norm": layer_norm,
            "clip": clip,
            **({"n_context": n_context} if n_context else {}),
        }
        self.n_observed = OBSERVATION + n_context
        self.inverse_error = float("nan")
        # What is drawn here is replaced.
        with usual_defaults(), th.random.fork_rng(devices=[]):
            policy = HerPolicy(
                _dict_space(self.n_observed),
                spaces.Box(-1.0, 1.0, (ACTION,), np.float32),
                lambda progress: 0.0,
                net_arch={"pi": list(pi), "qf": list(qf)},
                critic_layer_norm=layer_norm,
                features_clip=clip,
                n_critics=n_critics,
            )
            n_inputs = policy.actor.features_dim + self.n_observed
            layers = create_mlp(n_inputs, ACTION, list(inverse), squash_output=True)
        assert isinstance(policy.actor.features_extractor, NormalizedGoalExtractor)
        self.extractor = policy.actor.features_extractor
        self.nu = policy.actor.mu
        self.critics = nn.ModuleList(policy.critic.q_networks)
        self.inverse = nn.Sequential(*layers)
        self.requires_grad_(False)

    @classmethod
    def learned(
        cls,
        model: HerDDPG,
        env_id: str,
        physics: str,
        *,
        hidden: Sequence[int] = InverseSettings.hidden,
        learning_rate: float = InverseSettings.learning_rate,
        batch_size: int = InverseSettings.batch_size,
        updates: int = InverseSettings.updates,
        seed: int = 0,
        between_updates: Callable[[], None] = lambda: None,
    ) -> ObjectNetworks:
        """Copy critic and policy of a trained object and fit the inverse model to its replay.

        The inverse model sees what the object stage learned from: its transitions, relabelled.

        Args:
            model: of the object stage, with its replay buffer.
            env_id: gymnasium id of the robot's task.
            physics: hash of the task's physics.
            hidden: widths of the inverse model's hidden layers, each >= 1.
            learning_rate: of its Adam, > 0.
            batch_size: transitions an update, >= 1.
            updates: >= 1.
            seed: of its weights.
            between_updates: called after each; may raise to stop.

        Raises:
            ValueError: an argument is outside its range, or the policy has mirrors, or other
                activations than ReLU.
        """
        settings = InverseSettings(
            hidden=hidden, learning_rate=learning_rate, batch_size=batch_size, updates=updates
        )
        seed = checked_whole("seed", seed)
        policy = model.policy
        check_readable(policy)
        assert policy.net_arch is not None
        pi, qf = get_actor_critic_arch(policy.net_arch)
        extractor = model.actor.features_extractor
        assert isinstance(model.observation_space, spaces.Dict)
        observed = model.observation_space["observation"]
        assert isinstance(observed, spaces.Box)
        assert isinstance(extractor, NormalizedGoalExtractor)
        networks = cls(
            env_id,
            physics,
            pi=pi,
            qf=qf,
            inverse=settings.hidden,
            n_critics=len(model.critic.q_networks),
            layer_norm=policy.critic_layer_norm,
            clip=extractor.clip,
            n_context=observed.shape[0] - OBSERVATION,
        ).to(model.device)
        networks.extractor.load_state_dict(extractor.state_dict())
        networks.nu.load_state_dict(model.actor.mu.state_dict())
        for copy, critic in zip(networks.critics, model.critic.q_networks, strict=True):
            copy.load_state_dict(critic.state_dict())
        with usual_defaults():
            networks._fit_inverse(model, settings, seed, between_updates)
        return networks

    def _fit_inverse(
        self,
        model: HerDDPG,
        settings: InverseSettings,
        seed: int,
        between_updates: Callable[[], None],
    ) -> None:
        assert model.replay_buffer is not None
        with th.random.fork_rng(devices=[]):
            th.manual_seed(seed)
            for layer in self.inverse:
                if isinstance(layer, nn.Linear):
                    layer.reset_parameters()
        self.inverse.requires_grad_(True)
        optimizer = th.optim.Adam(self.inverse.parameters(), lr=settings.learning_rate)
        losses: list[th.Tensor] = []
        for _ in range(settings.updates):
            data = model.replay_buffer.sample(settings.batch_size)
            inferred = self.infer(
                data.observations["observation"],
                data.next_observations["observation"],
                data.observations["desired_goal"],
            )
            loss = nn.functional.mse_loss(inferred, data.actions)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            losses.append(loss.detach())
            between_updates()
        self.inverse.requires_grad_(False)
        self.inverse_error = float(th.stack(losses[-100:]).mean())

    def features(self, states: th.Tensor, goals: th.Tensor) -> th.Tensor:
        """Standardise states (n, n_observed) and goals (n, 3) as the object stage did."""
        return self.extractor({"observation": states, "desired_goal": goals})

    def act(self, states: th.Tensor, goals: th.Tensor) -> th.Tensor:
        """Return nu's actions (n, 7)."""
        return self.nu(self.features(states, goals))

    def value(self, states: th.Tensor, goals: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """Return Q_obj of actions (n, 1)."""
        inputs = th.cat([self.features(states, goals), actions], dim=1)
        return lowest([critic(inputs) for critic in self.critics])

    def infer(self, states: th.Tensor, next_states: th.Tensor, goals: th.Tensor) -> th.Tensor:
        """Return the actions (n, 7) that would have led from states to next states."""
        after = self.features(next_states, goals)[:, : self.n_observed]
        return self.inverse(th.cat([self.features(states, goals), after], dim=1))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write one safetensors file, whose metadata say in JSON what it was made for."""
        save_tree(
            path,
            {
                "format": FORMAT,
                "env_id": self.env_id,
                "physics": self.physics,
                "inverse_error": self.inverse_error,
                "shape": self.shape,
                "tensors": self.state_dict(),
            },
        )

    @classmethod
    def load(
        cls,
        path: str | os.PathLike[str],
        env_id: str | None = None,
        physics: str | None = None,
    ) -> ObjectNetworks:
        """Read what `save` wrote.

        Args:
            path: of the file.
            env_id: the task that it is wanted for, with or without a module; None accepts any.
            physics: the physics that it is wanted for; None accepts any.

        Raises:
            ValueError: the file is missing or damaged, or was made for another task or physics.
        """
        saved = load_tree(path)
        try:
            if saved["format"] != FORMAT:
                raise ValueError(f"its format is {saved['format']!r}, not {FORMAT}")
            _check_shape(saved["shape"])
            networks = cls(str(saved["env_id"]), str(saved["physics"]), **saved["shape"])
            networks.load_state_dict(saved["tensors"])
            networks.inverse_error = float(saved["inverse_error"])
            if not all(bool(th.isfinite(value).all()) for value in networks.state_dict().values()):
                raise ValueError("it holds NaN or infinity")
        except (AttributeError, KeyError, TypeError, ValueError, RuntimeError) as error:
            raise ValueError(
                f"{path} does not hold an object's networks ({reason(error)})"
            ) from error
        networks.check(env_id, physics, f"the object's networks in {path}")
        return networks

    def check(self, env_id: str | None, physics: str | None, what: str) -> None:
        """Raise a ValueError unless they were made for this task and physics."""
        env_id = env_id and without_module(env_id)
        for name, wanted in (("env_id", env_id), ("physics", physics)):
            found = getattr(self, name)
            if wanted is not None and found != wanted:
                raise ValueError(
                    f"{what} were made for {name} {found!r}, not for {wanted!r}; run the object "
                    "stage of that task"
                )


def check_readable(policy: HerPolicy) -> None:
    """Raise a ValueError for an object's policy that SLDR's reward cannot read."""
    if policy.activation_fn is not nn.ReLU:
        raise ValueError(
            "SLDR's reward reads an object policy with ReLU, not "
            f"{policy.activation_fn.__name__}; leave activation_fn out of object_algorithm"
        )
    if policy.mirrors:
        raise ValueError(
            "SLDR's reward reads an object's policy without mirrors; leave them out of "
            "object_algorithm"
        )


def _dict_space(n_observed: int) -> spaces.Dict:
    sizes = {"observation": n_observed, "achieved_goal": GOAL, "desired_goal": GOAL}
    return spaces.Dict({key: spaces.Box(-np.inf, np.inf, (n,)) for key, n in sizes.items()})


def _check_shape(shape: Any) -> None:
    """Raise unless a network of this shape can be built without allocating at a file's will."""
    for name in ("pi", "qf", "inverse"):
        if not valid_hidden(shape[name]):
            raise ValueError(f"{name} has hidden layers {shape[name]!r}")
    if shape.get("n_context", 0) not in range(CONTEXT_LIMIT + 1):
        raise ValueError(f"n_context is {shape['n_context']!r}")
    if type(shape["n_critics"]) is not int or not 1 <= shape["n_critics"] <= CRITICS_LIMIT:
        raise ValueError(f"n_critics is {shape['n_critics']!r}")
    if type(shape["layer_norm"]) is not bool or not float(shape["clip"]) > 0.0:
        raise ValueError("layer_norm or clip is invalid")
