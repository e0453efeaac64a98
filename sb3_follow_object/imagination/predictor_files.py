"""The two files of a saved predictor, and what they must be before anything is made of them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch
from safetensors import SafetensorError

from ..envs.goal_space import KINDS, POSITIONS, GoalSpace
from ..settings.kinds import LAYERS_LIMIT, WIDTH_LIMIT

TENSORS_FILE = "predictor.safetensors"
FACTS_FILE = "predictor.json"
FORMAT = 1
FACTS_LIMIT = 1 << 20  # bytes
HEADER_LIMIT = 1 << 20  # bytes that a tensors file may hold beside the numbers
HORIZON_LIMIT = 100_000
CONTEXT_LIMIT = 1000  # numbers of a context
SCALES = ("input_mean", "input_std", "output_mean", "output_std")  # tensors that are not weights


def n_inputs(goals: GoalSpace, context: Sequence[str]) -> int:
    """Return how many numbers F_phi sees: o_1, g, those of the context, k."""
    return 2 * goals.n_encoded + len(context) + 1


def without_module(env_id: str) -> str:
    """Return an id as `gymnasium.make` tells it in a spec, by which files name a task."""
    return env_id.rpartition(":")[2]


def valid_hidden(hidden: Any) -> bool:
    """Whether this is a list of widths of hidden layers."""
    return (
        isinstance(hidden, list)
        and 1 <= len(hidden) <= LAYERS_LIMIT
        and all(type(width) is int and 1 <= width <= WIDTH_LIMIT for width in hidden)
    )


def checked_facts(path: Path) -> dict[str, Any]:
    """Return what a predictor's JSON says of it.

    Raises:
        ValueError: it is missing, oversized or no such description.
    """
    damaged = f"{path} is not the description of a predictor"
    try:
        facts = json.loads(_read(path, FACTS_LIMIT))
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise ValueError(f"{damaged}: it is not JSON ({error}).") from error
    if not isinstance(facts, dict) or facts.get("format") != FORMAT:
        raise ValueError(f"{damaged} of format {FORMAT}.")
    for name in ("env_id", "physics", "sha256"):
        if not isinstance(facts.get(name), str):
            raise ValueError(f"{damaged}: {name} must be a string, got {facts.get(name)!r}.")
    facts["env_id"] = without_module(facts["env_id"])  # files of before hold it as it was given
    if not isinstance(facts.get("object_on_table"), bool | None):
        raise ValueError(f"{damaged}: object_on_table must be true, false or null.")
    horizon, errors = facts.get("horizon"), facts.get("error_mm")
    if type(horizon) is not int or not 1 <= horizon <= HORIZON_LIMIT:
        raise ValueError(f"{damaged}: horizon must lie in 1..{HORIZON_LIMIT}, got {horizon!r}.")
    if facts.get("goals", POSITIONS.kind) not in KINDS:
        raise ValueError(f"{damaged}: goals must be of one of the kinds {list(KINDS)}.")
    context = facts.get("context", [])  # only where there is one
    if (
        not isinstance(context, list)
        or len(context) > CONTEXT_LIMIT
        or not all(isinstance(name, str) and " " in name for name in context)
    ):
        raise ValueError(f"{damaged}: context is not a list of bodies' names and their numbers'.")
    if not valid_hidden(facts.get("hidden")):
        raise ValueError(f"{damaged}: hidden is not a list of widths.")
    if (
        not isinstance(errors, list)
        or len(errors) != horizon
        or not all(type(error) in (int, float) and 0.0 <= error < np.inf for error in errors)
    ):
        raise ValueError(f"{damaged}: error_mm must be {horizon} finite numbers >= 0.")
    return facts


def checked_tensors(
    path: Path, goals: GoalSpace, hidden: Sequence[int], context: Sequence[str], sha256: str
) -> dict[str, torch.Tensor]:
    """Return a predictor's weights, float32, and scales, float64, by their names.

    The file may hold the weights as float16.

    Args:
        path: of the safetensors file.
        goals: what they are.
        hidden: widths of the hidden layers.
        context: names of its numbers.
        sha256: digest of the file's bytes.

    Raises:
        ValueError: it is missing, oversized or another file, or holds what no predictor does.
    """
    inputs, outputs = n_inputs(goals, context), goals.n_encoded
    expected: dict[str, tuple[tuple[int, ...], torch.dtype]] = {
        name: ((inputs if name.startswith("input") else outputs,), torch.float64) for name in SCALES
    }
    for layer, (n_in, n_out) in enumerate(pairwise([inputs, *hidden, outputs])):
        # A ReLU stands between two linear layers, so these have the even places.
        expected[f"{2 * layer}.weight"] = ((n_out, n_in), torch.float32)
        expected[f"{2 * layer}.bias"] = ((n_out,), torch.float32)
    limit = HEADER_LIMIT + sum(
        int(np.prod(shape)) * dtype.itemsize for shape, dtype in expected.values()
    )
    data = _read(path, limit)
    if hashlib.sha256(data).hexdigest() != sha256:
        raise ValueError(f"{path} is damaged or belongs to another {FACTS_FILE}.")
    try:
        tensors = safetensors.torch.load(data)
    except SafetensorError as error:
        raise ValueError(f"{path} is not a safetensors file ({error}).") from error
    tensors = {
        name: value.float() if value.dtype == torch.float16 else value
        for name, value in tensors.items()
    }
    found = {name: (tuple(value.shape), value.dtype) for name, value in tensors.items()}
    if found != expected:
        raise ValueError(f"{path} does not hold the tensors of hidden layers {list(hidden)}.")
    if not all(bool(torch.isfinite(value).all()) for value in tensors.values()):
        raise ValueError(f"{path} holds NaN or infinity.")
    if not all(bool((tensors[name] > 0).all()) for name in ("input_std", "output_std")):
        raise ValueError(f"{path} holds a standard deviation that is not positive.")
    return tensors


def _read(path: Path, limit: int) -> bytes:
    """Return the file's bytes, refusing a missing or oversized one before reading it."""
    try:
        size = path.stat().st_size
        if size > limit:
            raise ValueError(f"{path} has {size} bytes, more than the {limit} it can need.")
        return path.read_bytes()
    except OSError as error:
        raise ValueError(f"Cannot read {path} of a predictor: {error.strerror}.") from error
