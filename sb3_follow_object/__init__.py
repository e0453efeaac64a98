"""Follow the Object for Stable-Baselines3: imagined goals and a curriculum over them.

Importing the package registers the gymnasium ids ``FollowObject/...``. The learning classes are
loaded when first used: whoever wants the environments alone does not wait for them.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from .envs import register_envs

register_envs()

__version__ = "0.1.0"

if TYPE_CHECKING:
    from .auxiliary import AuxiliaryReward as AuxiliaryReward
    from .callbacks import CurriculumCallback as CurriculumCallback
    from .curriculum import Curriculum as Curriculum
    from .eval_callback import OriginalGoalEvalCallback as OriginalGoalEvalCallback
    from .follow_object import FollowObject as FollowObject
    from .goal_predictor import GoalPredictor as GoalPredictor
    from .her_ddpg import HerDDPG as HerDDPG
    from .her_replay_buffer import FollowObjectReplayBuffer as FollowObjectReplayBuffer
    from .object_networks import ObjectNetworks as ObjectNetworks
    from .wrappers import ImaginedGoalVecEnv as ImaginedGoalVecEnv
    from .wrappers import ImaginedGoalWrapper as ImaginedGoalWrapper

_HOME = {
    "AuxiliaryReward": "auxiliary",
    "Curriculum": "curriculum",
    "CurriculumCallback": "callbacks",
    "FollowObject": "follow_object",
    "FollowObjectReplayBuffer": "her_replay_buffer",
    "GoalPredictor": "goal_predictor",
    "HerDDPG": "her_ddpg",
    "ImaginedGoalVecEnv": "wrappers",
    "ImaginedGoalWrapper": "wrappers",
    "ObjectNetworks": "object_networks",
    "OriginalGoalEvalCallback": "eval_callback",
}

__all__ = [*_HOME, "register_envs"]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_HOME[name]}", __name__), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME})
