"""Random network distillation: a bonus for what has not been seen often (Burda et al., 2018)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import torch as th
from stable_baselines3.common.torch_layers import create_mlp
from torch import nn

from ..settings.learning import RndSettings
from .auxiliary import AuxiliaryReward, Transitions


class RndReward(AuxiliaryReward):
    """How badly a network predicts a fixed random one on the next observation and goal.

    The bonus is the squared error summed over the outputs, divided by the running standard
    deviation of all errors so far, so it lies in [0, max_bonus]. Nothing is subtracted: the bonus
    of what is known well goes to zero.

    Args:
        n_features: length of the normalised observation and goal.
        hidden: widths of the hidden layers of both networks, each >= 1.
        n_outputs: of both networks, >= 1.
        learning_rate: of the predicting network's Adam, > 0.
        max_bonus: where the bonus of a step is cut, > 0; bounds the critic's targets.

    Raises:
        ValueError: an argument is outside its range.
    """

    name: ClassVar[str] = "rnd"

    # Running moments of the errors.
    mean: th.Tensor
    var: th.Tensor
    count: th.Tensor

    def __init__(
        self,
        n_features: int,
        hidden: Sequence[int] = RndSettings.hidden,
        n_outputs: int = RndSettings.n_outputs,
        learning_rate: float = RndSettings.learning_rate,
        max_bonus: float = RndSettings.max_bonus,
    ) -> None:
        super().__init__()
        settings = RndSettings(
            hidden=hidden, n_outputs=n_outputs, learning_rate=learning_rate, max_bonus=max_bonus
        )
        self.reward_range = (0.0, settings.max_bonus)
        self.target, self.predictor = (
            nn.Sequential(*create_mlp(n_features, settings.n_outputs, settings.hidden))
            for _ in range(2)
        )
        for network in (self.target, self.predictor):
            _initialise(network)
        self.target.requires_grad_(False)
        for name, value in (("mean", 0.0), ("var", 0.0), ("count", 0.0)):
            self.register_buffer(name, th.tensor(value, dtype=th.float64))
        self.optimizer = th.optim.Adam(self.predictor.parameters(), lr=settings.learning_rate)

    def errors(self, batch: Transitions) -> th.Tensor:
        """Squared prediction error of each transition, summed over the outputs, (n, 1)."""
        inputs = batch.next_features
        with th.no_grad():
            wanted = self.target(inputs)
        return (self.predictor(inputs) - wanted).square().sum(dim=1, keepdim=True)

    def forward(self, batch: Transitions) -> th.Tensor:
        """Return the bonus of each transition (n, 1), and take its error into the moments."""
        errors = self.errors(batch)
        self._update_moments(errors.double())
        std = self.var.sqrt().clamp(min=1e-12).float()
        return (errors / std).clamp(max=self.reward_range[1])

    def update(self, batch: Transitions) -> None:
        """Let the predicting network come closer to the fixed one on a batch."""
        assert self.optimizer is not None
        loss = self.errors(batch).mean()
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()

    @th.no_grad()
    def _update_moments(self, errors: th.Tensor) -> None:
        n = errors.numel()
        total = self.count + n
        delta = errors.mean() - self.mean
        spread = self.var * self.count + errors.var(correction=0) * n
        self.mean += delta * n / total
        self.var.copy_((spread + delta**2 * self.count * n / total) / total)
        self.count.copy_(total)


def _initialise(network: nn.Sequential) -> None:
    """Orthogonal weights with gain sqrt(2): the outputs then vary as much as the inputs do."""
    for layer in network:
        if isinstance(layer, nn.Linear):
            nn.init.orthogonal_(layer.weight, 2.0**0.5)
            nn.init.zeros_(layer.bias)
