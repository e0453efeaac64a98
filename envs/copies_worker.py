"""The process in which some copies of somebody's environment run; started by `robot_copies`.

It is started as a program of its own, which imports no script of the user's again, and learns what
to make from a pickled function.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from traceback import format_exc
from typing import Any

import cloudpickle
import gymnasium as gym
import numpy as np

NUMBER = 8  # bytes before each question that hold its number; its answer has the same


class Copies:
    """Copies of one environment, stepped one after the other; episodes begin anew by themselves.

    What they answer is what SB3's DummyVecEnv does.

    Args:
        make: makes one.
        n: of them.
    """

    def __init__(self, make: Callable[[], gym.Env], n: int) -> None:
        self.envs = [make() for _ in range(n)]

    def reset(self, seeds: list[int | None], options: list[dict[str, Any]]) -> Any:
        """Begin an episode in each; return observations and infos."""
        results = [
            env.reset(seed=seed, **({"options": option} if option else {}))
            for env, seed, option in zip(self.envs, seeds, options, strict=True)
        ]
        return _stacked([obs for obs, _ in results]), [info for _, info in results]

    def step(self, actions: np.ndarray) -> Any:
        """Step each; return observations, rewards, ends, infos and the infos of new episodes."""
        rows, rewards, dones, infos = [], [], [], []
        begun: dict[int, dict[str, Any]] = {}
        for index, (env, action) in enumerate(zip(self.envs, actions, strict=True)):
            obs, reward, terminated, truncated, info = env.step(action)
            info["TimeLimit.truncated"] = truncated and not terminated
            if terminated or truncated:
                info["terminal_observation"] = obs
                obs, begun[index] = env.reset()
            rows.append(obs)
            rewards.append(reward)
            dones.append(terminated or truncated)
            infos.append(info)
        return _stacked(rows), np.array(rewards, np.float32), np.array(dones), infos, begun

    def method(self, index: int, name: str, args: Any, kwargs: Any) -> Any:
        """Call a method of one."""
        return self.envs[index].get_wrapper_attr(name)(*args, **kwargs)

    def apply(self, index: int, function: Callable[[gym.Env], Any]) -> Any:
        """Call a function of one."""
        return function(self.envs[index])

    def attribute(self, index: int, name: str) -> Any:
        """Read an attribute of one."""
        return self.envs[index].get_wrapper_attr(name)

    def set_attribute(self, index: int, name: str, value: Any) -> None:
        """Write an attribute of one."""
        self.envs[index].set_wrapper_attr(name, value)

    def render(self) -> list[Any]:
        """Draw each."""
        return [env.render() for env in self.envs]

    def wrapped(self, index: int, wrapper: type[gym.Wrapper]) -> bool:
        """Whether one has a wrapper of this class."""
        env = self.envs[index]
        while isinstance(env, gym.Wrapper):
            if isinstance(env, wrapper):
                return True
            env = env.env
        return False

    def close(self) -> None:
        """Close each."""
        for env in self.envs:
            env.close()


def _stacked(rows: list[dict[str, Any]]) -> dict[str, np.ndarray]:
    return {key: np.stack([np.asarray(row[key]) for row in rows]) for key in rows[0]}


def serve(pipe: Connection) -> None:
    """Answer what the other end asks until it is gone."""
    try:
        path, maker, n = pipe.recv()
    except (EOFError, ConnectionError):
        return
    sys.path[:] = path
    copies, number = None, 0
    try:
        while True:
            try:
                if copies is None:
                    copies = Copies(cloudpickle.loads(maker), n)
                    answer: Any = None
                else:
                    question = pipe.recv_bytes()
                    number = int.from_bytes(question[:NUMBER], "big")
                    name, arguments = cloudpickle.loads(question[NUMBER:])
                    answer = getattr(copies, name)(*arguments)
                pipe.send((number, None, answer))
            except (EOFError, ConnectionError, KeyboardInterrupt):
                break
            except Exception as error:  # an environment of somebody's may raise anything
                with suppress(OSError):
                    pipe.send((number, (_told(error), format_exc()), None))
                if copies is None:
                    break
    finally:
        if copies is not None:
            copies.close()


def _told(error: Exception) -> Exception:
    """An error as the other process can raise it: of its kind, if that is one of Python's."""
    kind = type(error)
    with suppress(TypeError):  # some take more than a sentence
        if kind.__module__ == "builtins":
            return kind(str(error))
    return RuntimeError(f"{kind.__name__}: {error}" if str(error) else kind.__name__)


if __name__ == "__main__":
    serve(Connection(int(sys.argv[1])))
