"""rl_zoo3 with HerDDPG among its algorithms: ``python -m sb3_follow_object.zoo train ...``.

rl_zoo3 reads --algo before it imports --gym-packages, so an algorithm cannot come in as an
environment does: it has to be in the table before rl_zoo3's own commands begin.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

from stable_baselines3.common.buffers import DictReplayBuffer

from .common.extras import need
from .ddpg.her_ddpg import HerDDPG
from .settings.presets import preset_file

ALGORITHM = "her_ddpg"
COMMANDS = ("train", "enjoy")
PROGRAM = "python -m sb3_follow_object.zoo"


class ZooHerDDPG(HerDDPG):
    """HerDDPG that can be loaded to act without an environment, as rl_zoo3.enjoy does."""

    @classmethod
    def load(cls, path: Any, env: Any = None, *args: Any, **kwargs: Any) -> ZooHerDDPG:
        """Load a model; arguments as in SB3. Without an environment it can act, not learn."""
        if env is None:
            # A hindsight buffer needs an environment to reward what it relabels.
            kwargs |= {"buffer_size": 1, "replay_buffer_kwargs": {}}
            kwargs["replay_buffer_class"] = DictReplayBuffer
        return super().load(path, env, *args, **kwargs)


def register() -> None:
    """Make rl_zoo3 know HerDDPG as "her_ddpg".

    Raises:
        ValueError: rl_zoo3 is not installed.
    """
    need("rl_zoo3", "zoo").ALGOS[ALGORITHM] = ZooHerDDPG


def main(argv: Sequence[str] | None = None) -> int:
    """Run rl_zoo3's train or enjoy; return the exit status, 2 on bad input.

    The defaults are --algo her_ddpg and, for train, --conf-file with this package's fo.yml.

    Args:
        argv: the command and rl_zoo3's arguments; by default the process's.
    """
    command, *arguments = (sys.argv[1:] if argv is None else argv) or [""]
    if command not in COMMANDS:
        print(f"{PROGRAM}: give {' or '.join(COMMANDS)} first, not {command!r}", file=sys.stderr)
        return 2
    defaults = ["--algo", ALGORITHM]
    if command == "train":
        defaults += ["--conf-file", str(preset_file("fo"))]
    sys.argv = [f"{PROGRAM} {command}", *defaults, *arguments]
    try:
        register()
        getattr(need(f"rl_zoo3.{command}", "zoo"), command)()
    except ValueError as error:
        print(f"{PROGRAM}: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
