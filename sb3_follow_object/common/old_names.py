"""Modules by the names that they had in version 0.1, which pickled models and buffers hold."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_loader
from types import ModuleType

_PACKAGE = __name__.partition(".")[0]
# What SB3's zip files and `save_replay_buffer` name.
_PLACES = {
    "auxiliary": "ddpg.auxiliary",
    "cher": "replay.cher",
    "episode_table": "replay.episode_table",
    "her_ddpg": "ddpg.her_ddpg",
    "her_replay_buffer": "replay.her_replay_buffer",
    "moments": "ddpg.input_moments",
    "object_networks": "object_stage.networks",
    "policies": "ddpg.policies",
    "record_buffer": "replay.record_buffer",
    "records": "replay.records",
    "rnd": "ddpg.rnd",
    "sldr": "object_stage.sldr",
}


class _OldNames(MetaPathFinder, Loader):
    """Finds the module of today under the name that it had."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        package, _, name = fullname.partition(".")
        known = package == _PACKAGE and name in _PLACES
        return spec_from_loader(fullname, self) if known else None

    def create_module(self, spec: ModuleSpec) -> None:
        return None

    def exec_module(self, module: ModuleType) -> None:
        place = _PLACES[module.__name__.partition(".")[2]]
        sys.modules[module.__name__] = import_module(f"{_PACKAGE}.{place}")


def keep_old_names() -> None:
    """Let what was pickled before be loaded; a second call changes nothing."""
    if not any(isinstance(finder, _OldNames) for finder in sys.meta_path):
        sys.meta_path.append(_OldNames())
