"""An actor and its normaliser alone in a file: small, and without pickle."""

from __future__ import annotations

import os
from itertools import pairwise

import torch as th
from gymnasium import spaces
from stable_baselines3.td3.policies import Actor
from torch import nn

from ..common.array_trees import load_tree, save_tree
from ..common.mirrors import as_mirrors
from ..common.reports import reason
from ..common.torch_helpers import usual_defaults
from .folding import folding_of
from .policies import FoldedActor, NormalizedGoalExtractor

# Activation functions that a policy's file may name.
_ACTIVATIONS: dict[str, type[nn.Module]] = {
    each.__name__: each for each in (nn.ReLU, nn.Tanh, nn.ELU, nn.GELU, nn.SiLU)
}


def save_actor(path: str | os.PathLike[str], actor: Actor, env_id: str) -> None:
    """Save an actor and its normaliser alone: a small file, without pickle.

    Args:
        path: file to create or replace, e.g. policy.safetensors.
        actor: of a `HerPolicy`.
        env_id: the task that it was trained for.

    Raises:
        ValueError: it is no actor of a `HerPolicy`, or has an activation function that a file
            cannot name.
    """
    extractor = getattr(actor, "features_extractor", None)
    if not isinstance(extractor, NormalizedGoalExtractor):
        raise ValueError(
            "save_actor takes the actor of a HerPolicy, e.g. model.policy.actor_average, not "
            f"{type(actor).__name__}"
        )
    folding = extractor.folding
    activation = actor.activation_fn.__name__
    if _ACTIVATIONS.get(activation) is not actor.activation_fn:
        raise ValueError(
            f"a policy's file can name the activations {', '.join(_ACTIVATIONS)}, not {activation}"
        )
    saved = {
        "env_id": env_id,
        "net_arch": actor.net_arch,
        "activation": activation,
        "clip": extractor.clip,
    }
    if folding is None:
        saved["actor"] = actor.state_dict()
    else:  # by another name: who knows no mirrors shall not play it
        saved["mirrors"] = [each.plain() for each in folding.mirrors]
        saved["folded_actor"] = actor.state_dict()
    save_tree(path, saved)


def load_actor(
    path: str | os.PathLike[str], observation_space: spaces.Dict, action_space: spaces.Box
) -> tuple[Actor, str]:
    """Load what `save_actor` wrote; the actor has SB3's `predict`.

    Returns:
        The actor and the id of the task that it was trained for.

    Raises:
        ValueError: the file is missing, damaged or made for other spaces.
    """
    saved = load_tree(path)
    try:
        # The first files had none of these.
        clip, activation = float(saved.get("clip", 5.0)), saved.get("activation", "ReLU")
        if not clip > 0.0:
            raise ValueError(f"its inputs are clipped at {clip}")
        mirrors = as_mirrors(saved.get("mirrors", []))
        weights = saved["folded_actor" if "folded_actor" in saved else "actor"]
        with usual_defaults():
            folding = folding_of(mirrors, observation_space, action_space)
            extractor = NormalizedGoalExtractor(observation_space, clip, folding)
        widths = [extractor.features_dim, *saved["net_arch"], *action_space.shape]
        _check_layers(weights, widths)  # before anything of their size is allocated
        with usual_defaults():
            actor = FoldedActor(
                observation_space,
                action_space,
                saved["net_arch"],
                extractor,
                extractor.features_dim,
                _ACTIVATIONS[activation],
            )
        actor.load_state_dict(weights)
        actor.set_training_mode(False)
        return actor, str(saved["env_id"])
    except (AttributeError, KeyError, TypeError, RuntimeError, ValueError) as error:
        raise ValueError(
            f"{path} is not a policy for this environment ({reason(error)})"
        ) from error


def _check_layers(tensors: dict[str, th.Tensor], widths: list[int]) -> None:
    """Raise a ValueError unless the tensors are finite and those of layers with these widths."""
    if not all(bool(th.isfinite(value).all()) for value in tensors.values()):
        raise ValueError("it holds NaN or infinity")
    for layer, (n_in, n_out) in enumerate(pairwise(widths)):
        # An activation stands between two linear layers, so these have the even places.
        shape = tuple(tensors[f"mu.{2 * layer}.weight"].shape)
        if shape != (n_out, n_in):
            raise ValueError(f"layer {layer} has the shape {shape}, not {(n_out, n_in)}")
