"""Planes of symmetry of environments that are known and name none."""

from __future__ import annotations

from gymnasium import spaces

from ..common.mirrors import Mirror, as_mirrors
from ..zoo_configs import FOLDER
from .zoo_yaml import read_yaml

PLANES = FOLDER / "mirrors.yml"


def known_mirrors(
    env_id: str, observation_space: spaces.Space, action_space: spaces.Space
) -> list[Mirror]:
    """Return the mirrors that `PLANES` has for an id, none where a wrapper has changed its spaces.

    Args:
        env_id: registered id, without a module before it.
        observation_space: of the environment as it is trained in.
        action_space: of the same.
    """
    entry = read_yaml(PLANES).get(env_id)
    if entry is None or not isinstance(observation_space, spaces.Dict):
        return []
    shapes = observation_space["observation"].shape, action_space.shape
    if shapes != ((entry["observation"],), (entry["action"],)):
        return []
    return as_mirrors(entry["mirrors"])
