"""Settings of the curriculum, its tests, and the three stages around what learns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from .fields import Flag, Group, Number, Whole, checked, setting, settings_of
from .kinds import Indices, Standoff
from .learning import AlgorithmSettings, InverseSettings, PredictorSettings

COPIES, THREADS = 4096, 1024  # what is more would fill the memory

BEHIND = 0.06  # metres, the standoff where objects are pushed


@dataclass(frozen=True)
class CurriculumSettings(Group):
    """Which goal an episode shows."""

    title = "`curriculum`, of `Curriculum`"
    p: Annotated[Number, setting("probability of the original goal", ge=0, le=1)] = 0.2
    threshold: Annotated[Number, setting("success rate at k_max that raises k_max", ge=0, le=1)] = (
        0.25
    )
    sequential: Annotated[
        Flag, setting("whether tests of a level add up until they decide, or each stands alone")
    ] = False
    stride: Annotated[
        Whole,
        setting("most levels that a passed test raises k_max by, one for each threshold", ge=1),
    ] = 1
    finish_threshold: Annotated[
        Number,
        setting("success rate at the last level that ends the curriculum; 0, none", ge=0, le=1),
    ] = 0.0
    k_max: Annotated[Whole, setting("first value of k_max, at most the number of levels", ge=1)] = 2
    levels: Annotated[
        Literal["time", "path"], setting("whether levels are time-steps or shares of the path")
    ] = "time"
    n_levels: Annotated[
        Whole, setting('how many there are with levels "path"; "time" has T', ge=1, le=10_000)
    ] = 25
    sampling: Annotated[
        Literal["uniform", "max"], setting("whether levels are drawn from 1..k_max, or k_max taken")
    ] = "uniform"
    min_distance: Annotated[
        Number,
        setting("imagined goals nearer to the start are not shown", unit="metres", ge=0),
    ] = 0.0
    go_on: Annotated[
        Number,
        setting(
            "share of the training's episodes that go on to the original goal where they reach "
            "their imagined one; needs FollowObjectReplayBuffer",
            ge=0,
            le=1,
        ),
    ] = 0.0


@dataclass(frozen=True)
class CurriculumTestSettings(Group):
    """The tests of h_max (`CurriculumCallback`)."""

    title = "Of the tests at h_max (`CurriculumCallback`)"
    n_episodes: Annotated[
        Whole | None, setting("episodes of a test", none="one of every copy", ge=1)
    ] = None
    every: Annotated[Whole, setting("cycles between two tests", ge=1)] = 1
    store: Annotated[Flag, setting("whether the tests enter the replay buffer")] = True


@dataclass(frozen=True)
class ReachFirstSettings(Group):
    """How the effector reaches for the object before the learner acts."""

    where, whose = "reach", "ReachFirstWrapper"
    effector: Annotated[Indices, setting("where the observation holds the effector's position")] = (
        0,
        1,
        2,
    )
    tolerance: Annotated[
        Number, setting("within which the effector has arrived", unit="metres", gt=0)
    ] = 0.03
    height: Annotated[
        Number, setting("above the place that it is taken to first", unit="metres", ge=0)
    ] = 0.1
    standoff: Annotated[
        Standoff,
        setting(
            "of the place behind the object, as its way goes; `auto`, 0.06 where it is pushed over "
            "the table, else 0",
            unit="metres",
        ),
    ] = "auto"
    noise: Annotated[
        Number, setting("standard deviation on each action while it reaches", ge=0)
    ] = 0.1
    max_steps: Annotated[Whole, setting("after which the learner acts all the same", ge=1)] = 25


@dataclass(frozen=True)
class ReachTeachingSettings(Group):
    """How reaching is learned, and how many episodes begin with it."""

    where, whose = "reach", "ReachCallback"
    share: Annotated[
        Number, setting("of the episodes that begin with reaching at first", ge=0, le=1)
    ] = 0.5
    fade: Annotated[
        Flag, setting("whether the share falls as the learner comes to the object by itself")
    ] = True
    n_updates: Annotated[
        Whole,
        setting(
            "gradient steps of the reach policy after a rollout while all that it does fails; as "
            "many fewer as it succeeds",
            ge=1,
        ),
    ] = 120
    batch_size: Annotated[Whole, setting("transitions of each of them", ge=1, le=10**6)] = 256


@dataclass(frozen=True)
class ReachSettings(ReachFirstSettings, ReachTeachingSettings):
    """Both together, as `FollowObject` takes them."""

    title = "`reach`, the first four of `ReachCallback`, the others of `ReachFirstWrapper`"


def part_of_reach(
    part: type[ReachFirstSettings] | type[ReachTeachingSettings], given: Mapping[str, Any], who: str
) -> dict[str, Any]:
    """Return the settings of reaching first that its wrapper or its callback is given.

    Args:
        part: whose settings they are.
        given: by their names.
        who: beginning of the sentence about what is invalid.

    Raises:
        ValueError: an unknown name, one that is the other's to have, or a value that cannot be
            meant.
    """
    other = ReachTeachingSettings if part is ReachFirstSettings else ReachFirstSettings
    for name in settings_of(other):
        if name in given:
            raise ValueError(f"{who} has no setting {name!r}; give it to {other.whose}")
    return checked(part, given, who)


@dataclass(frozen=True)
class StageSettings(Group):
    """The three stages (`FollowObject`)."""

    title = "Of the three stages (`FollowObject`)"
    imagine: Annotated[Flag, setting("whether the robot is shown imagined goals", data=False)] = (
        True
    )
    n_envs: Annotated[Whole, setting("copies of the robot's environment", ge=1, le=COPIES)] = 16
    n_threads: Annotated[
        Whole | None,
        setting("of the simulation; changes no result", none="as many as cores", ge=1, le=THREADS),
    ] = None
    reward_type: Annotated[
        Literal["sparse", "dense"], setting("whether -1 or 0 is paid, or the distance")
    ] = "sparse"
    algorithm: Annotated[
        dict[str, Any] | None,
        setting("of the robot's algorithm", none="{}", group=AlgorithmSettings, data=False),
    ] = None
    reach: Annotated[
        dict[str, Any] | None,
        setting("reaching for the object first", none="no reaching", group=ReachSettings),
    ] = None
    curriculum: Annotated[
        dict[str, Any] | None,
        setting("which goals are shown", none="{}", group=CurriculumSettings),
    ] = None
    object_algorithm: Annotated[
        dict[str, Any] | None,
        setting(
            "of the object's algorithm", none="{}", group=AlgorithmSettings, without=("policy",)
        ),
    ] = None
    object_on_table: Annotated[
        Flag | None,
        setting(
            "whether the object stays on the table",
            none="in Push tasks; elsewhere by the goals' heights",
        ),
    ] = None
    object_n_envs: Annotated[
        Whole, setting("copies of the object's environment", ge=1, le=COPIES)
    ] = 16
    object_timesteps: Annotated[
        Whole, setting("env steps after which a trial of the object's policy gives up", ge=1)
    ] = 400_000
    object_test_every: Annotated[
        Whole, setting("rollouts of every copy between two tests of the object", ge=1)
    ] = 8
    object_test_episodes: Annotated[Whole, setting("episodes of such a test", ge=1)] = 64
    object_success: Annotated[
        Number, setting("success rate of two such tests in a row that ends its stage", ge=0, le=1)
    ] = 0.98
    object_error: Annotated[
        Number,
        setting(
            "mean error of F_phi, in metres, beyond which the object learns as long again; 0, none",
            ge=0,
        ),
    ] = 0.0
    n_paths: Annotated[Whole, setting("object paths that F_phi is fitted on", ge=2, le=10**6)] = 512
    predictor_fit: Annotated[
        dict[str, Any] | None, setting("of F_phi", none="{}", group=PredictorSettings)
    ] = None
    inverse_fit: Annotated[
        dict[str, Any] | None,
        setting("of SLDR's inverse model", none="{}", group=InverseSettings),
    ] = None
    test_every: Annotated[
        Whole, setting("rollouts of every copy between two tests at h_max", ge=1)
    ] = 4
    n_test_episodes: Annotated[
        Whole | None, setting("episodes of such a test", none="`n_envs`", ge=1)
    ] = None
    store_tests: Annotated[Flag, setting("whether they enter the replay buffer")] = True
