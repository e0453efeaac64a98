"""A policy as an ONNX file: normaliser and clipping inside, checked against `predict`."""

from __future__ import annotations

import copy
import inspect
import os
import warnings
from io import BytesIO
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from torch import nn

from ..common.extras import need
from ..common.files import atomic_write

TOLERANCE = 1e-5  # of actions, times the size of the action space where that is above 1
_OPSET = 17
_EXTRA = "onnx"
_ONLY_INPUT = "observation"  # where the observation has no keys
_OUTPUT, _BATCH = "action", "batch"
_CHECKED = (1, 7)  # batch sizes


def export_onnx(model: Any, path: str | os.PathLike[str]) -> float:
    """Write a policy as an ONNX file that acts as `predict(..., deterministic=True)` does.

    The file has an input for each key of the observation, named as the key, `(batch, *shape)`
    float32 where the space holds floats, and one output "action", `(batch, *shape)`. What a policy
    does to observations is inside, and so is the clipping of actions; a VecNormalize around the
    environment is not the policy's and stays outside. The file is compared with `predict` by
    ONNX Runtime before it takes its name.

    Args:
        model: an SB3 algorithm or policy, a `FollowObject`, or what `load_actor` returns.
        path: file to create or replace, e.g. policy.onnx.

    Returns:
        The largest difference from `predict` that was found.

    Raises:
        MissingExtra: onnx or onnxruntime is not installed.
        ValueError: the model has no policy yet, or one that cannot be written as ONNX.
    """
    onnx, runtime = need("onnx", _EXTRA), need("onnxruntime", _EXTRA)
    policy = _policy_of(model)
    names = _inputs(policy.observation_space)
    try:
        policy = copy.deepcopy(policy).to("cpu")
        policy.set_training_mode(False)
        content = _traced(policy, names, onnx)
    except Exception as error:  # PyTorch's exporter and onnx raise errors of many kinds
        first = str(error).strip().splitlines()[:1] or [type(error).__name__]
        raise ValueError(
            f"a {type(policy).__name__} cannot be written as ONNX ({first[0]})"
        ) from error
    session = runtime.InferenceSession(content, providers=["CPUExecutionProvider"])
    difference = max(_difference(policy, names, session, n) for n in _CHECKED)
    if not difference <= TOLERANCE * _size(policy.action_space):
        raise ValueError(
            f"the ONNX file of a {type(policy).__name__} acts otherwise than predict(), by up to "
            f"{difference:.2g}; it was not written"
        )
    atomic_write(path, content)
    return difference


def _policy_of(model: Any) -> BasePolicy:
    algorithm = getattr(model, "model", model)  # a FollowObject's
    policy = getattr(algorithm, "policy", algorithm)
    if not isinstance(policy, BasePolicy):
        raise ValueError(
            f"export_onnx takes an SB3 algorithm or policy that exists, not {policy!r}"
        )
    return policy


def _inputs(space: spaces.Space) -> dict[str, spaces.Space]:
    """Return the spaces of the file's inputs by name, each with draws of its own."""
    named = dict(space.spaces) if isinstance(space, spaces.Dict) else {_ONLY_INPUT: space}
    if _OUTPUT in named:
        raise ValueError(
            f"the observation has a key {_OUTPUT!r}, as the output of an ONNX file; rename it"
        )
    named = copy.deepcopy(named)
    for part in named.values():
        part.seed(0)
    return named


class _Predict(nn.Module):
    """SB3's `predict` from tensors to tensors."""

    def __init__(self, policy: BasePolicy, keys: list[str]) -> None:
        super().__init__()
        self.policy, self.keys = policy, keys
        box = policy.action_space if isinstance(policy.action_space, spaces.Box) else None
        self.has_bounds = box is not None
        if box is not None:
            self.register_buffer("low", th.as_tensor(box.low))
            self.register_buffer("high", th.as_tensor(box.high))

    def forward(self, *parts: th.Tensor) -> th.Tensor:
        is_dict = isinstance(self.policy.observation_space, spaces.Dict)
        obs: Any = dict(zip(self.keys, parts, strict=True)) if is_dict else parts[0]
        actions = self.policy._predict(obs, deterministic=True)
        actions = actions.reshape((-1, *(self.policy.action_space.shape or ())))
        if not self.has_bounds:
            return actions
        if self.policy.squash_output:
            return self.low + 0.5 * (actions + 1.0) * (self.high - self.low)  # type: ignore[operator]
        return th.maximum(th.minimum(actions, self.high), self.low)  # type: ignore[arg-type]


def _traced(policy: BasePolicy, names: dict[str, spaces.Space], onnx: Any) -> bytes:
    """Trace the policy: PyTorch's newer exporter would need a package more, onnxscript."""
    example = {name: th.as_tensor(_example(space, 2)) for name, space in names.items()}
    older = {"dynamo": False} if "dynamo" in inspect.signature(th.onnx.export).parameters else {}
    file = BytesIO()
    with warnings.catch_warnings(), th.no_grad():
        warnings.simplefilter("ignore")  # that it is the older one
        th.onnx.export(
            _Predict(policy, list(names)),
            tuple(example.values()),
            file,  # type: ignore[arg-type]
            input_names=list(names),
            output_names=[_OUTPUT],
            dynamic_axes={name: {0: _BATCH} for name in (*names, _OUTPUT)},
            opset_version=_OPSET,
            **older,  # type: ignore[arg-type]
        )
    model = onnx.load_from_string(file.getvalue())
    # What the policy does not look at was left out: whoever runs the file need not know that.
    kept = {value.name: value for value in model.graph.input}
    inputs = []
    for name, tensor in example.items():
        kind = onnx.helper.np_dtype_to_tensor_dtype(tensor.numpy().dtype)
        shape = [_BATCH, *tensor.shape[1:]]
        inputs.append(kept.get(name) or onnx.helper.make_tensor_value_info(name, kind, shape))
    del model.graph.input[:]
    model.graph.input.extend(inputs)
    onnx.checker.check_model(model)
    content: bytes = model.SerializeToString()
    return content


def _example(space: spaces.Space, n: int) -> np.ndarray:
    """Draw observations (n, *shape): float32 for floats."""
    drawn = np.stack([np.asarray(space.sample()) for _ in range(n)])
    return drawn.astype(np.float32) if np.issubdtype(drawn.dtype, np.floating) else drawn


def _difference(policy: BasePolicy, names: dict[str, spaces.Space], session: Any, n: int) -> float:
    """Return by how much the file's actions differ from the policy's at most."""
    obs: Any = {name: _example(space, n) for name, space in names.items()}
    (actions,) = session.run([_OUTPUT], obs)
    is_dict = isinstance(policy.observation_space, spaces.Dict)
    wanted, _ = policy.predict(obs if is_dict else obs[_ONLY_INPUT], deterministic=True)
    if actions.shape != wanted.shape:
        return np.inf
    return float(np.abs(actions.astype(np.float64) - wanted).max(initial=0.0))


def _size(space: spaces.Space) -> float:
    """Return the largest action's size, at least 1."""
    if not isinstance(space, spaces.Box):
        return 1.0
    bounds = np.abs(np.concatenate([space.low.ravel(), space.high.ravel()]))
    return float(max(1.0, bounds[np.isfinite(bounds)].max(initial=1.0)))
