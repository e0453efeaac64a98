"""What F_phi's network is, what it is trained on, and how (paper, section 4.2)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
import torch
from torch import nn

from ..envs.goal_space import KINDS, GoalSpace, goal_space

Progress = Callable[[int, float], None]


def make_network(inputs: int, hidden: Sequence[int], outputs: int) -> nn.Sequential:
    """Return the network with its weights unset: setting them here would use the global RNG."""
    widths = [inputs, *hidden]
    layers: list[nn.Module] = []
    for n_in, n_out in pairwise(widths):
        layers += [nn.utils.skip_init(nn.Linear, n_in, n_out), nn.ReLU()]
    layers.append(nn.utils.skip_init(nn.Linear, widths[-1], outputs))
    return nn.Sequential(*layers)


def initialise(network: nn.Sequential, generator: torch.Generator) -> None:
    """Draw the weights as nn.Linear does by default, from ``generator``."""
    for layer in network:
        if isinstance(layer, nn.Linear):
            bound = layer.in_features**-0.5
            nn.init.uniform_(layer.weight, -bound, bound, generator=generator)
            nn.init.uniform_(layer.bias, -bound, bound, generator=generator)


def make_samples(
    paths: np.ndarray, goals: np.ndarray, contexts: np.ndarray, space: GoalSpace
) -> tuple[np.ndarray, np.ndarray]:
    """Return inputs and targets, a row for every path and every k in 1..T."""
    n, horizon = len(paths), paths.shape[1] - 1
    start, goals, ahead = (space.encode(each) for each in (paths[:, 0], goals, paths[:, 1:]))
    fixed = np.repeat(np.concatenate([start, goals, contexts], axis=1), horizon, axis=0)
    k = np.tile(np.arange(1.0, horizon + 1), n)[:, None]
    return np.concatenate([fixed, k], axis=1), ahead.reshape(n * horizon, -1)


def train_network(
    network: nn.Sequential,
    inputs: torch.Tensor,
    targets: torch.Tensor,
    *,
    learning_rate: float,
    batch_size: int,
    epochs: int,
    generator: torch.Generator,
    progress: Progress | None,
) -> None:
    """Fit a network to samples, on the device that they lie on (paper, equation 3)."""
    optimiser = torch.optim.Adam(network.parameters(), lr=learning_rate)
    for epoch in range(1, epochs + 1):
        order = torch.randperm(len(inputs), generator=generator).to(inputs.device)
        total = torch.zeros((), device=inputs.device)
        for x, y in zip(
            inputs[order].split(batch_size), targets[order].split(batch_size), strict=True
        ):
            loss = nn.functional.mse_loss(network(x), y)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            total += loss.detach() * len(x)
        if progress is not None:
            progress(epoch, float(total) / len(inputs))


def checked_paths(paths: np.ndarray, goals: np.ndarray) -> tuple[np.ndarray, np.ndarray, GoalSpace]:
    """Return paths (n, T+1, 3) and goals (n, 3), finite float64, and the space that they lie in."""
    paths, goals = np.asarray(paths, dtype=np.float64), np.asarray(goals, dtype=np.float64)
    space = goal_space(paths.shape[2:] or (0,))
    if paths.ndim != 3 or len(paths) < 2 or paths.shape[1] < 2 or space.kind not in KINDS:
        raise ValueError(
            f"paths must have the shape (n, T+1, 3) with n >= 2 and T >= 1, got {paths.shape}."
        )
    if goals.shape != (len(paths), space.size):
        raise ValueError(
            f"goals must have the shape ({len(paths)}, {space.size}), got {goals.shape}."
        )
    if not (np.isfinite(paths).all() and np.isfinite(goals).all()):
        raise ValueError("paths and goals must be finite, got NaN or infinity in them.")
    return paths, goals, space


def checked_contexts(contexts: np.ndarray | None, n: int, names: Sequence[str]) -> np.ndarray:
    """Return finite contexts (n, c) of n episodes, float64."""
    given = np.zeros((n, 0)) if contexts is None else np.asarray(contexts, dtype=np.float64)
    if given.shape != (n, len(names)):
        seen = f", of {', '.join(names)}" if names else ""
        raise ValueError(
            f"contexts must have the shape ({n}, {len(names)}){seen}, got "
            f"{'none' if contexts is None else given.shape}."
        )
    if not np.isfinite(given).all():
        raise ValueError("contexts must be finite, got NaN or infinity in them.")
    return given
