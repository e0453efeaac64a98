"""Follow the Object for Stable-Baselines3: imagined goals and a curriculum over them.

Importing the package registers the gymnasium ids ``FollowObject/...``. The learning classes are
loaded when first used: whoever wants the environments alone does not wait for them.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from .common.old_names import keep_old_names
from .common.providers import provide
from .envs import register_envs, register_task

__version__ = "0.2.0"

if TYPE_CHECKING:
    from .any_task.effectors import fingertips as fingertips
    from .callbacks.curriculum_callback import CurriculumCallback as CurriculumCallback
    from .callbacks.eval_callback import OriginalGoalEvalCallback as OriginalGoalEvalCallback
    from .callbacks.reach_callback import ReachCallback as ReachCallback
    from .common.mirrors import Mirror as Mirror
    from .ddpg.actor_files import load_actor as load_actor
    from .ddpg.actor_files import save_actor as save_actor
    from .ddpg.auxiliary import AuxiliaryReward as AuxiliaryReward
    from .ddpg.goal_policy import GoalPolicy as GoalPolicy
    from .ddpg.her_ddpg import HerDDPG as HerDDPG
    from .ddpg.layer_norm import LayerNormReLU as LayerNormReLU
    from .ddpg.onnx_files import export_onnx as export_onnx
    from .ddpg.policies import HerPolicy as HerPolicy
    from .envs import make_vec as make_vec
    from .follow_object.follow_object import FollowObject as FollowObject
    from .imagination.curriculum import Curriculum as Curriculum
    from .imagination.goal_predictor import GoalPredictor as GoalPredictor
    from .imagination.vec_env import ImaginedGoalVecEnv as ImaginedGoalVecEnv
    from .imagination.wrapper import ImaginedGoalWrapper as ImaginedGoalWrapper
    from .object_stage.networks import ObjectNetworks as ObjectNetworks
    from .reach.vec_env import ReachFirstVecEnv as ReachFirstVecEnv
    from .reach.wrapper import ReachFirstWrapper as ReachFirstWrapper
    from .replay.her_replay_buffer import FollowObjectReplayBuffer as FollowObjectReplayBuffer
    from .runs.evaluation import evaluate as evaluate
    from .runs.experiment import train as train
    from .runs.hub_folder import load_hub_folder as load_hub_folder
    from .runs.hub_folder import write_hub_folder as write_hub_folder
    from .runs.predictor_cache import get_object_networks as get_object_networks
    from .runs.predictor_cache import get_predictor as get_predictor
    from .settings.presets import preset_file as preset_file
    from .settings.presets import run_config as run_config
    from .settings.run_config import RunConfig as RunConfig

_HOME = {
    "AuxiliaryReward": "ddpg.auxiliary",
    "Curriculum": "imagination.curriculum",
    "CurriculumCallback": "callbacks.curriculum_callback",
    "FollowObject": "follow_object.follow_object",
    "FollowObjectReplayBuffer": "replay.her_replay_buffer",
    "GoalPolicy": "ddpg.goal_policy",
    "GoalPredictor": "imagination.goal_predictor",
    "HerDDPG": "ddpg.her_ddpg",
    "HerPolicy": "ddpg.policies",
    "ImaginedGoalVecEnv": "imagination.vec_env",
    "ImaginedGoalWrapper": "imagination.wrapper",
    "LayerNormReLU": "ddpg.layer_norm",
    "Mirror": "common.mirrors",
    "ObjectNetworks": "object_stage.networks",
    "OriginalGoalEvalCallback": "callbacks.eval_callback",
    "ReachCallback": "callbacks.reach_callback",
    "ReachFirstVecEnv": "reach.vec_env",
    "ReachFirstWrapper": "reach.wrapper",
    "RunConfig": "settings.run_config",
    "evaluate": "runs.evaluation",
    "export_onnx": "ddpg.onnx_files",
    "fingertips": "any_task.effectors",
    "get_object_networks": "runs.predictor_cache",
    "get_predictor": "runs.predictor_cache",
    "load_actor": "ddpg.actor_files",
    "load_hub_folder": "runs.hub_folder",
    "make_vec": "envs.make",
    "preset_file": "settings.presets",
    "run_config": "settings.presets",
    "save_actor": "ddpg.actor_files",
    "train": "runs.experiment",
    "write_hub_folder": "runs.hub_folder",
}

__all__ = [*_HOME, "register_envs", "register_task"]

register_envs()
keep_old_names()
provide("predictor", "auto", f"{__name__}.runs.predictor_cache:get_predictor")
provide("object networks", "auto", f"{__name__}.runs.predictor_cache:get_object_networks")
provide("auxiliary reward", "rnd", f"{__name__}.ddpg.rnd:RndReward")
provide("auxiliary reward", "sldr", f"{__name__}.object_stage.sldr:SldrReward")


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_HOME[name]}", __name__), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME})
