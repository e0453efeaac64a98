"""Copies of the robot's environment: a few processes with several of them each."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from multiprocessing.connection import Connection
from socket import SHUT_RDWR, socket, socketpair
from typing import Any, NoReturn, cast

import cloudpickle
import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvCreator, EnvSpec, load_env_creator
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from ..common.numbers import checked_whole
from ..common.reports import named_reason
from .batch import cores
from .copies_worker import NUMBER
from .copies_worker import __name__ as WORKER
from .make import make_vec
from .registration import import_robotics, import_task, registration_key
from .robot_face import RobotTask, needs_face
from .robotics import is_of_robotics
from .task_table import IDS

_LEAST = 2  # copies that are worth a process
_CLOSING_S = 10.0  # seconds that a process has to close its copies
# What judges goals and knows nothing of an episode, so that any copy may be asked.
_JUDGES = ("compute_reward", "is_success", "_is_success")


def robot_vec_env(env_id: str, n_envs: int, n_threads: int | None = None, **options: Any) -> VecEnv:
    """A VecEnv of n copies of any robot's task, which all answer as `RobotTask` does.

    This package's own tasks are batched; others run in processes, which give the same results
    however many there are.

    Args:
        env_id: any gymnasium id, with "module:" before it where importing that registers it.
        n_envs: number of copies, at least 1.
        n_threads: threads or processes that step them; None takes one a core.
        options: keywords of the environment.

    Raises:
        ValueError: as `make_vec`, or what the environment lacks cannot be added.
    """
    name = import_task(env_id)
    if name in IDS or name not in gym.registry:
        return make_vec(env_id, n_envs, n_threads, **options)
    n_envs = checked_whole("n_envs", n_envs, 1)
    n_threads = cores() if n_threads is None else checked_whole("n_threads", n_threads, 1)
    make = robot_maker(name, **options)
    workers = min(n_threads, n_envs // _LEAST)
    if workers <= 1 or os.name != "posix":
        return DummyVecEnv([make] * n_envs)
    return ProcessVecEnv(make, n_envs, workers)


def robot_maker(env_id: str, **options: Any) -> Callable[[], gym.Env]:
    """Return what makes one copy of a registered task, with what it lacks of `RobotTask`."""
    spec = gym.spec(import_task(env_id))
    lacks = _lacks_face(spec, options)
    if isinstance(spec.entry_point, str) and spec.entry_point.startswith("__main__:"):
        # Another process has another main program: it is sent what this one's name stands for.
        spec = replace(spec, entry_point=cast(EnvCreator, load_env_creator(spec.entry_point)))
    return partial(_make, spec, lacks, options)


def with_face(env: gym.Env) -> gym.Env:
    """Return an environment with what it lacks of `RobotTask`.

    Another of its kind is made and stepped to see that; one that gymnasium did not make is left
    alone.

    Raises:
        ValueError: no other can be made.
    """
    spec = env.spec
    if spec is None or spec.id in IDS or spec.id not in gym.registry or not may_be_faced(env):
        return env
    return _faced(env) if _lacks_face(spec, {}) else env


def _lacks_face(spec: EnvSpec, options: dict[str, Any]) -> bool:
    """Whether an environment with goals lacks what `RobotTask` adds, looked at once a process."""
    wrappers = tuple(wrapper.name for wrapper in spec.additional_wrappers)
    key = registration_key(spec, options), wrappers
    if key not in _LACKING:
        try:
            probe = _probe(spec, options)
            try:
                _LACKING[key] = may_be_faced(probe) and needs_face(probe)
            finally:
                probe.close()
        except ValueError:
            raise
        except Exception as error:  # an environment of somebody's may raise anything
            said = f"{type(error).__name__}: {error}"
            raise ValueError(f"{spec.id!r} cannot be made and begun: {said}") from error
    return _LACKING[key]


_LACKING: dict[Any, bool] = {}


def _probe(spec: EnvSpec, options: dict[str, Any]) -> gym.Env:
    """Make an environment anew, without the wrappers around it where they cannot be made anew."""
    try:
        return gym.make(spec, **options)
    except ValueError:
        if not spec.additional_wrappers:
            raise
        return gym.make(replace(spec, additional_wrappers=()), **options)


def _faced(env: gym.Env) -> gym.Env:
    known = env.has_wrapper_attr("followed_object")
    return RobotTask(env, object=env.get_wrapper_attr("followed_object") if known else None)


def may_be_faced(env: gym.Env) -> bool:
    """Whether an environment has goals, so that `RobotTask` can add the rest."""
    return isinstance(env.observation_space, spaces.Dict) and {"achieved_goal", "desired_goal"} <= (
        set(env.observation_space.spaces)
    )


def _make(spec: EnvSpec, wrapped: bool, options: dict[str, Any]) -> gym.Env:
    env = make_registered(spec, **options)
    return _faced(env) if wrapped else env


def make_registered(spec: EnvSpec, **options: Any) -> gym.Env:
    """Make an environment of gymnasium's, also in a process that has not registered it."""
    if is_of_robotics(spec):
        import_robotics()  # quietly, before gymnasium does so
    return gym.make(spec, **options)


class ProcessVecEnv(VecEnv):
    """Copies of an environment in processes, each of which steps several of them.

    A process that steps one copy waits longer for its orders than it works; one that steps eight
    does not. Results are those of SB3's DummyVecEnv. Goals are judged in this process, by a copy
    that is never stepped.

    Args:
        make: makes one copy; is sent to the processes by cloudpickle.
        n_envs: number of copies.
        n_workers: number of processes, at most `n_envs`.

    Raises:
        ValueError: `make` cannot be sent to the processes.
    """

    def __init__(self, make: Callable[[], gym.Env], n_envs: int, n_workers: int) -> None:
        maker = _sendable(make)
        self._judge = make()
        self._rows = np.array_split(np.arange(n_envs), n_workers)
        self._place = [(w, int(i)) for w, rows in enumerate(self._rows) for i in range(len(rows))]
        self._closed = False
        self._workers: list[_Worker] = []
        try:
            for rows in self._rows:
                self._workers.append(_Worker(maker, len(rows)))
            for worker in self._workers:
                worker.answer()  # all are making theirs at once
            super().__init__(n_envs, self._judge.observation_space, self._judge.action_space)
            self.metadata = self._judge.metadata
            self._judge.reset(seed=0)  # some judge by what a reset has made
        except BaseException:
            self.close()
            raise

    def reset(self) -> dict[str, np.ndarray]:
        """Begin an episode in every copy; seeds set by `seed()` count from here."""
        for worker, rows in zip(self._workers, self._rows, strict=True):
            seeds = [self._seeds[row] for row in rows]
            worker.ask("reset", seeds, [self._options[row] for row in rows])
        answers = self._answers()
        self.reset_infos = [info for _, infos in answers for info in infos]
        self._reset_seeds()
        self._reset_options()
        return self._joined([obs for obs, _ in answers])

    def step_async(self, actions: np.ndarray) -> None:
        """Send the actions (n_envs, ...) to the processes.

        Raises:
            ValueError: there are more or fewer actions.
        """
        actions = np.asarray(actions)
        if len(actions) != self.num_envs:
            raise ValueError(f"{len(actions)} actions were given for {self.num_envs} environments")
        for worker, rows in zip(self._workers, self._rows, strict=True):
            worker.ask_step(actions[rows])

    def step_wait(
        self,
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Wait until all have stepped."""
        answers = self._answers()
        obs, rewards, dones, infos, begun = zip(*answers, strict=True)
        for rows, news in zip(self._rows, begun, strict=True):
            for index, info in news.items():
                self.reset_infos[rows[index]] = info
        told = [info for some in infos for info in some]
        return self._joined(obs), np.concatenate(rewards), np.concatenate(dones), told

    def close(self) -> None:
        """End the processes."""
        if not self._closed:
            self._closed = True
            self._judge.close()
            for worker in self._workers:
                worker.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """A picture of every copy."""
        for worker in self._workers:
            worker.ask("render")
        return [image for images in self._answers() for image in images]

    def has_attr(self, attr_name: str) -> bool:
        """Whether the copies have an attribute."""
        return bool(self._judge.has_wrapper_attr(attr_name))

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Read an attribute of copies."""
        if attr_name == "spec":
            return [self._judge.spec for _ in self._get_indices(indices)]
        return self._each(indices, "attribute", attr_name)

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of copies."""
        if indices is None:
            self._judge.set_wrapper_attr(attr_name, value)
        self._each(indices, "set_attribute", attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of copies."""
        if method_name in _JUDGES:
            judge = self._judge.get_wrapper_attr(method_name)
            return [judge(*method_args, **method_kwargs) for _ in self._get_indices(indices)]
        if indices is None:  # it may change what the judge goes by
            self._judge.get_wrapper_attr(method_name)(*method_args, **method_kwargs)
        return self._each(indices, "method", method_name, method_args, method_kwargs)

    def apply(self, function: Callable[[gym.Env], Any], rows: Iterable[int]) -> list[Any]:
        """Return what a function says of copies, each in the process that it runs in."""
        return self._each(rows, "apply", function)

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: Any = None) -> list[bool]:
        """Whether copies have a wrapper of this class."""
        return self._each(indices, "wrapped", wrapper_class)

    def __reduce__(self) -> NoReturn:
        raise ValueError(
            "environments in processes cannot be copied; make them again, or take n_threads=1"
        )

    def _answers(self) -> list[Any]:
        """What every process has to say; what went wrong in one is raised once all have spoken."""
        answers, errors = [], []
        for worker in self._workers:
            try:
                answers.append(worker.answer())
            except Exception as error:  # an environment of somebody's may raise anything
                errors.append(error)
        if errors:
            raise errors[0]
        return answers

    def _each(self, indices: Any, name: str, *arguments: Any) -> list[Any]:
        answers = []
        for row in self._get_indices(indices):
            worker, index = self._place[row]
            self._workers[worker].ask(name, index, *arguments)
            answers.append(self._workers[worker].answer())
        return answers

    def _joined(self, parts: Sequence[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
        space = self.observation_space
        assert isinstance(space, spaces.Dict)
        return {
            key: np.concatenate([part[key] for part in parts]).astype(box.dtype, copy=False)
            for key, box in space.spaces.items()
        }


class _Worker:
    """A process with some copies, and this process's end of the line to it.

    Questions are numbered, so that answers that nobody waited for, as an exception came between,
    are not taken for those to what is asked next. Signals to this process's group do not reach it:
    it ends when the line does.

    Args:
        maker: makes one copy, pickled by cloudpickle.
        n: of them.
    """

    def __init__(self, maker: bytes, n: int) -> None:
        ours, theirs = socketpair()
        self._process = subprocess.Popen(
            [sys.executable, "-m", WORKER, str(theirs.fileno())],
            pass_fds=[theirs.fileno()],
            stdin=subprocess.DEVNULL,
            start_new_session=True,
        )
        theirs.close()
        self._pipe = Connection(ours.detach())
        self._asked = 0
        self._pipe.send((sys.path, maker, n))

    def ask(self, name: str, *arguments: Any) -> None:
        self._send(cloudpickle.dumps((name, arguments)))

    def ask_step(self, actions: np.ndarray) -> None:
        """Ask for a step; numbers need no cloudpickle, which takes three times as long."""
        self._send(pickle.dumps(("step", (actions,))))

    def _send(self, question: bytes) -> None:
        if self._pipe.closed:
            raise RuntimeError("the robot's environment is closed")
        self._asked += 1
        try:
            self._pipe.send_bytes(self._asked.to_bytes(NUMBER, "big") + question)
        except OSError as ended:
            raise self._has_ended() from ended

    def answer(self) -> Any:
        """Wait for what was asked last; raise what went wrong there."""
        number = -1
        while number < self._asked:
            try:
                number, error, answer = self._pipe.recv()
            except (EOFError, OSError) as ended:
                raise self._has_ended() from ended
        if error is not None:
            raised, traceback = error
            raise raised from RuntimeError(f"in a process of the robot's environment\n{traceback}")
        return answer

    def _has_ended(self) -> RuntimeError:
        return RuntimeError(
            "a process of the robot's environment has ended by itself (status "
            f"{self._process.wait()})"
        )

    def close(self) -> None:
        # Closing does not end a line that a fork of this process holds open too.
        with socket(fileno=os.dup(self._pipe.fileno())) as line, suppress(OSError):
            line.shutdown(SHUT_RDWR)
        self._pipe.close()
        try:
            self._process.wait(_CLOSING_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def _sendable(make: Callable[[], gym.Env]) -> bytes:
    """Pickle what makes a copy.

    Raises:
        ValueError: it cannot be.
    """
    try:
        return cloudpickle.dumps(make)
    except Exception as error:  # what somebody's function holds may raise anything
        raise ValueError(
            f"the environment cannot be sent to processes ({named_reason(error)}); take n_threads=1"
        ) from error
