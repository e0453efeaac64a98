"""Settings of what learns: replay, algorithm, auxiliary rewards, F_phi and the inverse model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from ..common.providers import provided
from ..common.suggestions import did_you_mean
from .fields import Anything, Flag, Group, Number, Text, Whole, checked, setting
from .kinds import (
    CRITICS_LIMIT,
    Bounds,
    Device,
    GradientSteps,
    Hidden,
    Mirrors,
    NetArch,
    Networks,
    Policy,
    PythonClass,
    Rate,
    Reward,
    Strategy,
    TargetClip,
    TrainFreq,
)

AUXILIARY = "auxiliary reward"  # as `providers` knows them


@dataclass(frozen=True)
class CherSettings(Group):
    """Which relabelled transitions to learn from."""

    title = "`replay_buffer_kwargs.cher`, of `GoalSelection`"
    where = "cher"
    candidates: Annotated[
        Whole, setting("drawn for each transition that is chosen", ge=1, le=10_000)
    ] = 2
    picks: Annotated[Whole, setting("random candidates that each pick looks at", ge=1)] = 3
    weight: Annotated[Number, setting("of proximity in the first batch", ge=0)] = 1.0
    growth: Annotated[Number, setting("factor on the weight from batch to batch", ge=1)] = 1.0001


@dataclass(frozen=True)
class ReplaySettings(Group):
    """What is stored and how it is relabelled."""

    title = "`replay_buffer_kwargs`, of `FollowObjectReplayBuffer`"
    n_sampled_goal: Annotated[
        Whole, setting("transitions with a hindsight goal for each with its own", ge=0)
    ] = 4
    goal_selection_strategy: Annotated[
        Strategy, setting("where in the episode hindsight goals are taken from")
    ] = "future"
    handle_timeout_termination: Annotated[
        Flag, setting("whether an episode that ran out of time is not one that ended")
    ] = True
    copy_info_dict: Annotated[
        Flag, setting("whether infos are stored; runs and saves cannot hold them")
    ] = False
    imagined_ratio: Annotated[
        Number, setting("share of the relabelled whose goal F_phi imagines", ge=0, le=1)
    ] = 0.0
    moved_ratio: Annotated[
        Number, setting("share of a batch from episodes that moved the object", ge=0, le=1)
    ] = 0.0
    moved_distance: Annotated[
        Number, setting("what an object that moved went at least", unit="metres", ge=0)
    ] = 0.01
    moved_priority: Annotated[
        Literal["uniform", "energy"], setting("how episodes that moved the object are drawn")
    ] = "uniform"
    step_seconds: Annotated[
        Number, setting("duration of an environment step, for speeds", unit="seconds", gt=0)
    ] = 0.04
    min_goal_distance: Annotated[
        Number,
        setting("a hindsight goal nearer to the start than this is not used", unit="metres", ge=0),
    ] = 0.0
    scene_distance: Annotated[
        Number,
        setting(
            "nearer to another episode's goal than this, and not to its own, a hindsight goal is "
            "not used once imagined goals are over; where things stand around goals",
            unit="metres",
            ge=0,
        ),
    ] = 0.0
    goal_margin: Annotated[
        Number, setting("share of the tolerance that is not good enough in replay", ge=0, lt=1)
    ] = 0.0
    cher: Annotated[
        dict[str, Any] | None,
        setting("chooses each batch from more candidates", none="none", group=CherSettings),
    ] = None
    reward_function: Annotated[
        Any, setting("f(achieved, desired, infos)", none="the environment's", data=False)
    ] = None
    seed: Annotated[
        Whole | None,
        setting("of the buffer's generator", none="drawn from NumPy's", data=False, ge=0),
    ] = None


@dataclass(frozen=True)
class AuxiliarySettings(Group):
    """A second reward with a critic of its own; a subclass has those of one reward."""

    title = "`auxiliary`, of every second reward"
    where = "auxiliary"
    name: Annotated[Reward, setting("which reward it is", none="must be given")] = None
    weight: Annotated[
        Number, setting("of the reward's critic beside the main one for the actor", ge=0)
    ] = 1.0

    @classmethod
    def of(cls, given: Mapping[str, Any]) -> type[Group]:
        """Return the settings of the reward that is named, or of all where none is."""
        if cls is not AuxiliarySettings or not isinstance(given, Mapping):
            return cls
        name = given.get("name")
        if name is None:
            return _AnyAuxiliarySettings
        if isinstance(name, type):
            return Anything  # its own arguments
        known = provided(AUXILIARY)
        if not isinstance(name, str) or name not in known:
            raise ValueError(f"auxiliary has no reward {name!r}{did_you_mean(str(name), known)}")
        return {"rnd": RndSettings, "sldr": SldrSettings}.get(name, Anything)


@dataclass(frozen=True)
class RndSettings(AuxiliarySettings):
    """A bonus for the unfamiliar."""

    title = "`auxiliary` with the name rnd, of `RndReward`"
    where, of_name = "auxiliary (rnd)", " (rnd)"
    hidden: Annotated[Hidden, setting("widths of the hidden layers of both networks")] = (256,) * 3
    n_outputs: Annotated[Whole, setting("of both networks", ge=1, le=8192)] = 256
    learning_rate: Annotated[Number, setting("of the predicting network's Adam", gt=0)] = 1e-3
    max_bonus: Annotated[Number, setting("where the bonus of a step is cut", gt=0)] = 5.0


@dataclass(frozen=True)
class SldrSettings(AuxiliarySettings):
    """The reward of the object's own stage."""

    title = "`auxiliary` with the name sldr, of `SldrReward`"
    where, of_name = "auxiliary (sldr)", " (sldr)"
    object_networks: Annotated[
        Networks, setting("what the reward reads; a run makes them itself and takes none")
    ] = "auto"


@dataclass(frozen=True)
class _AnyAuxiliarySettings(RndSettings, SldrSettings):
    """Where a change leaves out which reward it is of."""

    of_name = ""


@dataclass(frozen=True)
class PolicySettings(Group):
    """The networks."""

    title = "`policy_kwargs`, of `HerPolicy`"
    net_arch: Annotated[
        NetArch | None, setting("widths of the hidden layers", none="[256, 256, 256]")
    ] = None
    critic_layer_norm: Annotated[
        Flag, setting("whether LayerNorm follows each hidden layer of the critics")
    ] = False
    features_clip: Annotated[
        Number, setting("bound on the inputs", unit="standard deviations", gt=0)
    ] = 5.0
    mirrors: Annotated[
        Mirrors | None,
        setting(
            "planes over which the environment is symmetric; the networks see one side",
            none="none",
        ),
    ] = None
    n_critics: Annotated[
        Whole, setting("critics, whose lowest value counts", ge=1, le=CRITICS_LIMIT)
    ] = 1
    optimizer_kwargs: Annotated[
        dict[str, Any] | None, setting("of the optimiser", none="fused", group=Anything)
    ] = None
    activation_fn: Annotated[
        PythonClass | None, setting("of the hidden layers", none="ReLU", data=False)
    ] = None
    optimizer_class: Annotated[
        PythonClass | None, setting("of actor and critics", none="Adam", data=False)
    ] = None


@dataclass(frozen=True)
class GoalPolicySettings(Group):
    """The networks of stock DDPG and TD3."""

    title = "`policy_kwargs`, of `GoalPolicy`"
    action_l2: Annotated[
        Number, setting("weight of the mean squared action in the actor's loss", ge=0)
    ] = 1.0
    target_clip: Annotated[
        Bounds | None, setting("bounds of what the target critic says", none="none")
    ] = None


@dataclass(frozen=True)
class AlgorithmSettings(Group):
    """The robot's algorithm, and the object's."""

    title = "Of the algorithm (`HerDDPG`); `object_algorithm` has the same besides `policy`"
    policy: Annotated[Policy, setting("the only one")] = "MultiInputPolicy"
    learning_rate: Annotated[Rate, setting("of Adam, or SB3's schedule")] = 1e-3
    buffer_size: Annotated[
        Whole, setting("transitions of all environments that are kept", ge=1, le=10**8)
    ] = 1_000_000
    learning_starts: Annotated[
        Whole, setting("env steps with random actions before the first update", ge=0)
    ] = 0
    batch_size: Annotated[Whole, setting("transitions of an update", ge=1, le=10**6)] = 512
    tau: Annotated[Number, setting("how far targets move towards the networks", gt=0, le=1)] = 0.01
    gamma: Annotated[Number | None, setting("discount factor", none="1 - 1/T", ge=0, lt=1)] = None
    train_freq: Annotated[
        TrainFreq, setting("steps, or episodes, of every environment between updates")
    ] = (1, "episode")
    gradient_steps: Annotated[GradientSteps, setting("updates in turn")] = 40
    noise_std: Annotated[
        Number, setting("of the Gaussian noise on each action in [-1, 1]", ge=0)
    ] = 0.2
    random_action_prob: Annotated[
        Number, setting("probability of a uniform action", ge=0, le=1)
    ] = 0.3
    action_l2: Annotated[
        Number, setting("weight of the mean squared action in the actor's loss", ge=0)
    ] = 1.0
    target_clip: Annotated[
        TargetClip | None, setting('bounds of the targets; "auto" is [-1/(1 - gamma), 0]')
    ] = "auto"
    hindsight_bound: Annotated[
        Flag, setting("whether targets are at least what the stored episode proves possible")
    ] = False
    target_update_interval: Annotated[
        Whole, setting("updates between two moves of the targets", ge=1)
    ] = 1
    policy_delay: Annotated[Whole, setting("critic updates for each of the actor", ge=1)] = 1
    average_decay: Annotated[
        Number,
        setting("share that an update leaves of the averaged actor; 0, none", ge=0, lt=1),
    ] = 0.0
    matmul_precision: Annotated[
        Literal["highest", "high", "medium"], setting("of an update's float32 matrix products")
    ] = "highest"
    auxiliary: Annotated[
        dict[str, Any] | None, setting("a second reward", none="none", group=AuxiliarySettings)
    ] = None
    update_threads: Annotated[
        Whole | None,
        setting("PyTorch's in updates", none="as it has otherwise", data=False, ge=1, le=1024),
    ] = None
    replay_on_device: Annotated[
        Flag | None,
        setting("whether batches are made on the learner's device", none="on CUDA where it can"),
    ] = None
    replay_buffer_kwargs: Annotated[
        dict[str, Any] | None, setting("of the replay buffer", none="{}", group=ReplaySettings)
    ] = None
    policy_kwargs: Annotated[
        dict[str, Any] | None, setting("of the networks", none="{}", group=PolicySettings)
    ] = None
    verbose: Annotated[Whole, setting("what SB3 prints: 0 nothing, 1 a little", ge=0)] = 0
    device: Annotated[Device, setting('of PyTorch; "auto" is a GPU where there is one')] = "auto"
    action_noise: Annotated[Any, setting("in place of noise_std", none="noise_std", data=False)] = (
        None
    )
    replay_buffer_class: Annotated[
        PythonClass | None, setting("of SB3", none="FollowObjectReplayBuffer", data=False)
    ] = None
    tensorboard_log: Annotated[
        Text | None, setting("folder of SB3's log", none="no log", data=False)
    ] = None


@dataclass(frozen=True)
class PredictorSettings(Group):
    """The fit of F_phi."""

    title = "`predictor_fit`, of F_phi (`GoalPredictor.fit`)"
    hidden: Annotated[Hidden, setting("widths of the hidden layers")] = (512, 512, 512)
    learning_rate: Annotated[Number, setting("of Adam", gt=0)] = 1e-3
    batch_size: Annotated[Whole, setting("samples an update", ge=1, le=10**6)] = 128
    epochs: Annotated[Whole, setting("passes over the training samples", ge=1)] = 30
    test_share: Annotated[Number, setting("share of the paths that is held out", gt=0, lt=1)] = 0.3
    device: Annotated[
        Device, setting("of PyTorch that the fit is done on; in a run that of the object's policy")
    ] = "auto"


@dataclass(frozen=True)
class InverseSettings(Group):
    """The fit of SLDR's inverse model."""

    title = "`inverse_fit`, of SLDR's inverse model (`ObjectNetworks.learned`)"
    where = "inverse_fit"
    hidden: Annotated[Hidden, setting("widths of the hidden layers")] = (256, 256, 256)
    learning_rate: Annotated[Number, setting("of its Adam", gt=0)] = 1e-3
    batch_size: Annotated[Whole, setting("transitions an update", ge=1, le=10**6)] = 256
    updates: Annotated[Whole, setting("gradient steps", ge=1)] = 3000


def check_auxiliary(given: Any) -> None:
    """Raise a ValueError unless settings name an auxiliary reward and hold nothing but its own."""
    if not isinstance(given, Mapping) or "name" not in given:
        raise ValueError(f"auxiliary is {given!r}; give a mapping with a name, e.g. {{name: rnd}}")
    group = AuxiliarySettings.of(given)
    checked(group, given, AuxiliarySettings.where)
