"""`python -m short_films` is the command line with films of an episode: five take too long."""

from __future__ import annotations

import sys
from functools import partial

from sb3_follow_object.command import cli, pictures

record_an_episode = partial(pictures.record, n_episodes=1)

if __name__ == "__main__":
    pictures.record = record_an_episode  # type: ignore[assignment]
    sys.exit(cli.main())
