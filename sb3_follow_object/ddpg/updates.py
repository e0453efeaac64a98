"""Gradient steps of HerDDPG on batches that were drawn already, on CUDA as one graph."""

from __future__ import annotations

from typing import Any, Protocol

import torch as th
from torch import nn

from ..common.torch_helpers import lowest
from .auxiliary import AuxiliaryCritic, Transitions
from .policies import HerPolicy

COLUMNS = ("critic_loss", "actor_loss", "q_mean", "reward_mean")  # what is told of each step
_WARM_UP = 3  # calls before a graph is captured: libraries set themselves up in the first ones
_MAX_GRAPHS = 4  # kept for calls of different sizes


class Learner(Protocol):
    """What is updated: `HerDDPG`, whose attributes these are."""

    device: th.device
    policy: HerPolicy
    gamma: float
    tau: float
    action_l2: float
    hindsight_bound: bool
    target_update_interval: int
    policy_delay: int
    auxiliary_critic: AuxiliaryCritic | None
    _n_updates: int

    def _target_bounds(self) -> tuple[float, float]:
        """Return what targets are clipped to."""

    def _trained_parameters(self) -> tuple[list[th.Tensor], list[th.Tensor]]:
        """Return parameters of the live and of the target networks, in the same order."""


class Updates:
    """Takes the gradient steps of an algorithm.

    On CUDA, once warmed up, the steps of a call are captured as one graph and replayed: hundreds of
    small kernels then start without Python. What a graph depends on besides its inputs is its key;
    with another key another graph is captured. An auxiliary reward keeps its own counts in Python,
    so with one the steps run one by one.

    Args:
        model: whose networks are updated.
    """

    def __init__(self, model: Learner) -> None:
        self._model = model
        self._graphs: dict[Any, _Graph] = {}
        self._n_calls = 0

    def __getstate__(self) -> dict[str, Any]:
        # A graph is bound to the memory of the networks that it was captured on.
        return {"_model": self._model, "_graphs": {}, "_n_calls": 0}

    def run(
        self,
        chunk: Transitions,
        actions: th.Tensor,
        rewards: th.Tensor,
        dones: th.Tensor,
        bounds: th.Tensor,
        batch_size: int,
    ) -> th.Tensor:
        """Take a step for each batch of a chunk and return what `COLUMNS` names, (n_batches, 4).

        Args:
            chunk: of n_batches * batch_size transitions.
            actions: theirs, as the networks see them, (n, action_dim).
            rewards: of the transitions, (n, 1).
            dones: (n, 1), 1 where the episode terminated.
            bounds: the least targets that the episodes prove possible, (n, 1).
            batch_size: transitions of a step.
        """
        inputs = {
            "features": chunk.features,
            "next_features": chunk.next_features,
            "actions": actions,
            "rewards": rewards,
            "dones": dones,
            "bounds": bounds,
        }
        model = self._model
        if model.device.type == "cuda" and model.auxiliary_critic is None:
            told = self._run_on_cuda(inputs, batch_size)
        else:
            told = self._steps(inputs, batch_size, chunk)
        model._n_updates += len(told)
        return told

    def _steps(
        self, inputs: dict[str, th.Tensor], batch_size: int, chunk: Transitions | None = None
    ) -> th.Tensor:
        names, parts = list(inputs), [value.split(batch_size) for value in inputs.values()]
        batches = [None] * len(parts[0]) if chunk is None else chunk.split(batch_size)
        limits, parameters = self._model._target_bounds(), self._model._trained_parameters()
        return th.stack(
            [
                self._step(
                    dict(zip(names, part, strict=True)),
                    batch,
                    self._model._n_updates + number,
                    limits,
                    parameters,
                )
                for number, (batch, *part) in enumerate(zip(batches, *parts, strict=True), 1)
            ]
        )

    def _step(
        self,
        inputs: dict[str, th.Tensor],
        batch: Transitions | None,
        number: int,
        limits: tuple[float, float],
        parameters: tuple[list[th.Tensor], list[th.Tensor]],
    ) -> th.Tensor:
        """Take the step of this number, of critic, actor and, when it is time, targets.

        Targets are clipped to `limits`; `parameters` are the live networks' and the targets'.
        """
        model, auxiliary, policy = self._model, self._model.auxiliary_critic, self._model.policy
        critic, critics = policy.critic, policy.critic.q_networks
        actor_target = policy.actor_target.mu
        x, next_x = inputs["features"], inputs["next_features"]
        rewards, dones = inputs["rewards"], inputs["dones"]
        with th.no_grad():
            next_in = th.cat([next_x, actor_target(next_x)], dim=1)
            next_q = lowest([net(next_in) for net in policy.critic_target.q_networks])
            target_q = rewards + (1.0 - dones) * model.gamma * next_q
            target_q = target_q.clamp_(*limits)
            if model.hindsight_bound:
                target_q = th.maximum(target_q, inputs["bounds"])
        critic_in = th.cat([x, inputs["actions"]], dim=1)
        critic_loss = sum(nn.functional.mse_loss(net(critic_in), target_q) for net in critics)
        assert isinstance(critic_loss, th.Tensor)
        critic.optimizer.zero_grad()
        critic_loss.backward()
        critic.optimizer.step()
        if auxiliary is not None:
            assert batch is not None
            auxiliary.update(batch, critic_in, next_in, dones)

        told = [critic_loss.detach(), *self._actor_step(x, number), rewards.mean()]
        if number % model.target_update_interval == 0:
            live, target = parameters
            with th.no_grad():
                th._foreach_lerp_(target, live, model.tau)
        return th.stack(told)

    def _actor_step(self, x: th.Tensor, number: int) -> tuple[th.Tensor, th.Tensor]:
        """Take the actor's part of a step when it is due; return its loss and the value of x."""
        model, auxiliary, policy = self._model, self._model.auxiliary_critic, self._model.policy
        if number % model.policy_delay:
            none = x.new_full((), th.nan)
            return none, none
        # The actor's gradient passes through the critic, whose own is not wanted.
        policy.critic.requires_grad_(False)
        actions = policy.actor.mu(x)
        critic_in = th.cat([x, actions], dim=1)
        q = policy.critic.q_networks[0](critic_in).mean()
        value = q if auxiliary is None else q + auxiliary.value(critic_in)
        loss = -value + model.action_l2 * actions.square().mean()
        policy.actor.optimizer.zero_grad()
        loss.backward()
        policy.actor.optimizer.step()
        policy.critic.requires_grad_(True)
        return loss.detach(), q.detach()

    def _run_on_cuda(self, inputs: dict[str, th.Tensor], batch_size: int) -> th.Tensor:
        optimizers = (self._model.policy.actor.optimizer, self._model.policy.critic.optimizer)
        for optimizer in optimizers:
            for group in optimizer.param_groups:  # also those that load_state_dict has put there
                group["capturable"] = True
        self._n_calls += 1
        if self._n_calls <= _WARM_UP:
            side, main = th.cuda.Stream(), th.cuda.current_stream()
            side.wait_stream(main)
            with th.cuda.stream(side):
                told = self._steps(inputs, batch_size)
            main.wait_stream(side)
            return told
        key = self._key(inputs, batch_size)
        if key not in self._graphs:
            if len(self._graphs) == _MAX_GRAPHS:
                del self._graphs[next(iter(self._graphs))]
            for optimizer in optimizers:
                optimizer.zero_grad(set_to_none=True)
            self._graphs[key] = _Graph(self, inputs, batch_size)
        return self._graphs[key].replay(inputs)

    def _key(self, inputs: dict[str, th.Tensor], batch_size: int) -> Any:
        """What a captured graph has built in: sizes, rates, and where its tensors lie."""
        model = self._model
        optimizers = (model.policy.actor.optimizer, model.policy.critic.optimizer)
        numbers = range(1, len(inputs["rewards"]) // batch_size + 1)
        return (
            len(inputs["rewards"]),
            batch_size,
            tuple(
                (model._n_updates + i) % interval == 0
                for interval in (model.target_update_interval, model.policy_delay)
                for i in numbers
            ),
            tuple(group["lr"] for optimizer in optimizers for group in optimizer.param_groups),
            tuple(
                value.data_ptr()
                for optimizer in optimizers
                for state in optimizer.state.values()
                for value in state.values()
                if isinstance(value, th.Tensor)
            ),
            tuple(parameter.data_ptr() for parameter in model.policy.parameters()),
            (model.gamma, model.tau, model.action_l2, model.hindsight_bound),
            model._target_bounds(),
            th.get_float32_matmul_precision(),
        )


class _Graph:
    """The steps of one call as a CUDA graph with input tensors of its own."""

    def __init__(self, updates: Updates, inputs: dict[str, th.Tensor], batch_size: int) -> None:
        self._inputs = {name: value.clone() for name, value in inputs.items()}
        self._graph = th.cuda.CUDAGraph()
        with th.cuda.graph(self._graph):
            self._told = updates._steps(self._inputs, batch_size)

    def replay(self, inputs: dict[str, th.Tensor]) -> th.Tensor:
        for name, value in inputs.items():
            self._inputs[name].copy_(value)
        self._graph.replay()
        return self._told.clone()
