"""F_phi: the object's position k steps ahead on its way from o_1 to g (paper, section 4.2)."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import safetensors.torch
import torch

from ..common.copies import WholeCopies
from ..common.files import atomic_write
from ..common.numbers import checked_whole
from ..common.torch_helpers import one_thread_after_forks, usable_device, usual_defaults
from ..envs.goal_space import KINDS, POSITIONS, GoalSpace
from ..settings.learning import PredictorSettings
from .predictor_files import (
    FACTS_FILE,
    FORMAT,
    SCALES,
    TENSORS_FILE,
    checked_facts,
    checked_tensors,
    n_inputs,
    without_module,
)
from .predictor_training import (
    Progress,
    checked_contexts,
    checked_paths,
    initialise,
    make_network,
    make_samples,
    train_network,
)

# Metres. The start's height is the same in all paths up to the solver's noise; divided by that
# noise, half a millimetre in the robot's scene would be an input that the network has never seen.
SMALLEST_STD = 1e-2

one_thread_after_forks()


class GoalPredictor(WholeCopies):
    """A network that imagines where the object would be after k steps (paper, section 4.2).

    Made by ``fit`` or ``load``.

    Attributes:
        horizon: T, the largest k.
        env_id: gymnasium id of the task that it was made for, without a module before it.
        physics: short hash of the physics that it was made for.
        object_on_table: whether the object was kept on the table; None where that is not known.
        space: of its positions and goals.
        context: names of the numbers that it sees beside start and goal, of places of other things
            (`any_task.context`).
        error_mm: mean distance to the held-out paths for each k in 1..T, shape (T,), millimetres.
        device: that it imagines on, the CPU unless `to` says another.
    """

    space: GoalSpace = POSITIONS
    context: tuple[str, ...] = ()

    def __init__(
        self,
        tensors: dict[str, torch.Tensor],
        *,
        hidden: Sequence[int],
        horizon: int,
        env_id: str,
        physics: str,
        error_mm: np.ndarray,
        object_on_table: bool | None = None,
        context: Sequence[str] = (),
        space: GoalSpace = POSITIONS,
    ) -> None:
        self.hidden = tuple(hidden)
        self.horizon = horizon
        self.env_id = without_module(env_id)
        self.physics = physics
        self.object_on_table = object_on_table
        self.context = tuple(context)
        self.space = space
        self.error_mm = error_mm
        self.device = torch.device("cpu")
        self._tensors = tensors
        with usual_defaults():
            inputs = n_inputs(space, self.context)
            self._network = make_network(inputs, self.hidden, space.n_encoded)
        self._network.load_state_dict(
            {name: value for name, value in tensors.items() if name not in SCALES}
        )
        self._network.eval()
        # Copies: torch moves a tensor's memory when it is sent to another process.
        self._scales = {name: tensors[name].numpy().copy() for name in SCALES}

    @classmethod
    @usual_defaults()
    def fit(
        cls,
        paths: np.ndarray,
        goals: np.ndarray,
        *,
        env_id: str,
        physics: str,
        object_on_table: bool | None = None,
        context: Sequence[str] = (),
        contexts: np.ndarray | None = None,
        hidden: Sequence[int] = PredictorSettings.hidden,
        learning_rate: float = PredictorSettings.learning_rate,
        batch_size: int = PredictorSettings.batch_size,
        epochs: int = PredictorSettings.epochs,
        test_share: float = PredictorSettings.test_share,
        seed: int = 0,
        device: str = PredictorSettings.device,
        progress: Progress | None = None,
    ) -> GoalPredictor:
        """Fit F_phi to paths of the object policy by mean squared error (paper, equation 3).

        Whole paths are held out, so ``error_mm`` says how well unseen starts and goals are met.
        The result depends on ``seed`` and the device's kind alone and no global random state is
        touched.

        Args:
            paths: object positions o_1..o_{T+1} of n episodes, shape (n, T+1, 3), metres.
            goals: their goals g, shape (n, 3), metres.
            env_id: gymnasium id of the task, kept with the predictor; a module before it is not.
            physics: hash of the task's physics, kept with the predictor.
            object_on_table: whether the object was kept on the table, kept with the predictor.
            context: names of the numbers that the paths depend on beside start and goal.
            contexts: these numbers, shape (n, len(context)), metres or parts of an axis; None where
                there are none.
            hidden: widths of the hidden layers, each >= 1.
            learning_rate: of Adam, > 0.
            batch_size: samples an update, >= 1.
            epochs: passes over the training samples, >= 1.
            test_share: share of the paths that is held out, in (0, 1).
            seed: of the split, the weights and the order of the samples.
            device: of PyTorch that the fit is done on; "auto" is a GPU where there is one.
            progress: called after each epoch with its number from 1 and its mean loss, the
                squared error per coordinate in units of the paths' variance.

        Raises:
            ValueError: an argument has a wrong shape or range, or holds NaN or infinity.
        """
        paths, goals, space = checked_paths(paths, goals)
        contexts = checked_contexts(contexts, len(paths), context)
        settings = PredictorSettings(
            hidden=hidden,
            learning_rate=learning_rate,
            batch_size=batch_size,
            epochs=epochs,
            test_share=test_share,
            device=device,
        )
        on = usable_device(settings.device)
        n, horizon = len(paths), paths.shape[1] - 1
        n_test = min(max(round(settings.test_share * n), 1), n - 1)
        generator = torch.Generator().manual_seed(checked_whole("seed", seed))
        order = torch.randperm(n, generator=generator).numpy()
        test, train = order[:n_test], order[n_test:]

        inputs, targets = make_samples(paths[train], goals[train], contexts[train], space)
        tensors = {
            "input_mean": torch.from_numpy(inputs.mean(axis=0)),
            "input_std": torch.from_numpy(np.maximum(inputs.std(axis=0), SMALLEST_STD)),
            "output_mean": torch.from_numpy(targets.mean(axis=0)),
            "output_std": torch.from_numpy(np.maximum(targets.std(axis=0), SMALLEST_STD)),
        }
        network = make_network(n_inputs(space, context), settings.hidden, space.n_encoded)
        initialise(network, generator)
        x = (torch.from_numpy(inputs) - tensors["input_mean"]) / tensors["input_std"]
        y = (torch.from_numpy(targets) - tensors["output_mean"]) / tensors["output_std"]
        train_network(
            network.to(on),
            x.float().to(on),
            y.float().to(on),
            learning_rate=settings.learning_rate,
            batch_size=settings.batch_size,
            epochs=settings.epochs,
            generator=generator,
            progress=progress,
        )
        weights = network.cpu().state_dict()
        tensors |= {name: value.detach().clone() for name, value in weights.items()}
        predictor = cls(
            tensors,
            hidden=settings.hidden,
            horizon=horizon,
            env_id=env_id,
            physics=physics,
            object_on_table=object_on_table,
            context=context,
            space=space,
            error_mm=np.full(horizon, np.nan),
        )
        imagined = predictor.paths(paths[test, 0], goals[test], contexts[test])
        distance = space.distance(imagined[:, 1:], paths[test, 1:])
        predictor.error_mm = 1000.0 * distance.mean(axis=0)
        return predictor

    def to(self, device: torch.device | str) -> GoalPredictor:
        """Imagine on this device from now on; what `save` writes stays the same."""
        self.device = torch.device(device)
        self._network.to(self.device)
        return self

    def predict(
        self,
        start: np.ndarray,
        goal: np.ndarray,
        k: np.ndarray,
        contexts: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the imagined position at time-step k + 1, F_phi(o_1, g, k).

        Args:
            start: object positions o_1, shape (n, 3), metres.
            goal: goals g, shape (n, 3), metres.
            k: steps ahead, shape (n,) int, in 1..T.
            contexts: as `context` names them, shape (n, len(context)); None where it is empty.

        Returns:
            positions, shape (n, 3) float64, metres.

        Raises:
            ValueError: a shape is wrong, a k is no whole number in 1..T, or a start, a goal or a
                context is not finite.
        """
        start, goal, k = (np.asarray(values) for values in (start, goal, k))
        n = len(k) if k.ndim == 1 else -1
        space, size = self.space, self.space.size
        if start.shape != (n, size) or goal.shape != (n, size):
            raise ValueError(
                f"start, goal and k must have the shapes (n, {size}), (n, {size}) and (n,), "
                f"got {start.shape}, {goal.shape} and {k.shape}."
            )
        contexts = checked_contexts(contexts, n, self.context)
        if n == 0:
            return np.zeros((0, size))
        for name, values in (("start", start), ("goal", goal), ("k", k)):
            if not (np.issubdtype(values.dtype, np.number) and np.isfinite(values).all()):
                raise ValueError(f"{name} must hold finite numbers, got others in it.")
        if not (k.min() >= 1 and k.max() <= self.horizon):
            raise ValueError(
                f"k must lie in 1..{self.horizon}, got values from {k.min()} to {k.max()}."
            )
        if (k != np.round(k)).any():
            raise ValueError(f"k must hold whole numbers, got {k[k != np.round(k)][0]} in it.")
        parts = space.encode(start), space.encode(goal), contexts, k[:, None]
        inputs = np.concatenate(parts, axis=1, dtype=np.float64)
        with np.errstate(under="ignore"):
            scaled = (inputs - self._scales["input_mean"]) / self._scales["input_std"]
            scaled = scaled.astype(np.float32)
        with torch.inference_mode():
            on = torch.from_numpy(scaled).to(self.device)
            outputs = self._network(on).cpu().numpy()
        return space.decode(outputs * self._scales["output_std"] + self._scales["output_mean"])

    def paths(
        self, start: np.ndarray, goal: np.ndarray, contexts: np.ndarray | None = None
    ) -> np.ndarray:
        """Return whole imagined paths, o_1 and then F_phi for k = 1..T.

        Args:
            start: object positions o_1, shape (n, 3), metres.
            goal: goals g, shape (n, 3), metres.
            contexts: as in `predict`.

        Returns:
            paths, shape (n, T+1, 3) float64, metres.
        """
        start, goal = np.asarray(start, dtype=np.float64), np.asarray(goal, dtype=np.float64)
        ahead = self.predict(
            np.repeat(start, self.horizon, axis=0),
            np.repeat(goal, self.horizon, axis=0),
            np.tile(np.arange(1, self.horizon + 1), len(start)),
            *([] if contexts is None else [np.repeat(contexts, self.horizon, axis=0)]),
        )
        ahead = ahead.reshape(-1, self.horizon, self.space.size)
        return np.concatenate([start[:, None], ahead], axis=1)

    def save(self, folder: str | os.PathLike[str], half: bool = False) -> None:
        """Write ``predictor.safetensors`` and ``predictor.json`` into ``folder``.

        The facts come last and name the tensors' digest, so a pair that does not belong together
        is noticed when it is loaded.

        Args:
            folder: is created where it does not exist.
            half: write the weights as float16, which halves the file and rounds them.
        """
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        tensors = safetensors.torch.save(
            {
                name: value.half() if half and name not in SCALES else value
                for name, value in self._tensors.items()
            }
        )
        facts = {
            "format": FORMAT,
            "env_id": self.env_id,
            "physics": self.physics,
            "object_on_table": self.object_on_table,
            **({"goals": self.space.kind} if self.space.kind != POSITIONS.kind else {}),
            **({"context": list(self.context)} if self.context else {}),
            "horizon": self.horizon,
            "hidden": list(self.hidden),
            "error_mm": self.error_mm.tolist(),
            "sha256": hashlib.sha256(tensors).hexdigest(),
        }
        atomic_write(folder / TENSORS_FILE, tensors)
        atomic_write(folder / FACTS_FILE, json.dumps(facts, indent=1).encode())

    @classmethod
    def load(
        cls,
        folder: str | os.PathLike[str],
        env_id: str | None = None,
        physics: str | None = None,
        object_on_table: bool | None = None,
    ) -> GoalPredictor:
        """Read a predictor that ``save`` wrote.

        Args:
            folder: holds the two files.
            env_id: the task that it is wanted for, with or without a module; None accepts any.
            physics: the physics that it is wanted for; None accepts any.
            object_on_table: whether the object should have been kept on the table; None accepts
                both, and a predictor that does not say is accepted always.

        Raises:
            ValueError: a file is missing, damaged or oversized, or the predictor was made for
                another task, other physics or another object_on_table.
        """
        folder = Path(folder)
        facts = checked_facts(folder / FACTS_FILE)
        wanted = {"env_id": env_id and without_module(env_id), "physics": physics}
        for name, value in wanted.items():
            if value is not None and facts[name] != value:
                raise ValueError(
                    f"The predictor in {folder} was made for {name} {facts[name]!r}, "
                    f"not for {value!r}: fit one for that task."
                )
        made = facts.get("object_on_table")
        if None not in (made, object_on_table) and made != object_on_table:
            raise ValueError(
                f"The predictor in {folder} was made with object_on_table={made}, "
                f"not {object_on_table}: fit one with that setting."
            )
        space, context = KINDS[facts.get("goals", POSITIONS.kind)], facts.get("context", [])
        tensors = checked_tensors(
            folder / TENSORS_FILE, space, facts["hidden"], context, facts["sha256"]
        )
        return cls(
            tensors,
            hidden=facts["hidden"],
            horizon=facts["horizon"],
            env_id=facts["env_id"],
            physics=facts["physics"],
            object_on_table=made,
            context=context,
            space=space,
            error_mm=np.array(facts["error_mm"], dtype=np.float64),
        )
