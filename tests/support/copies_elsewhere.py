"""Processes in which copies of things are used as here.

`python copies_elsewhere.py fork` (or spawn) uses each of `THINGS` here and in another process and
prints how the two compare, as JSON.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import pickle
import select
import signal
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from copied_things import THINGS, Use, seeded

LIMIT = 20  # seconds that a use may take before it counts as hanging


def equal(one: Any, other: Any) -> bool:
    try:
        np.testing.assert_equal(one, other)
    except AssertionError:
        return False
    return True


def used_in_a_fork(thing: Any, use: Use) -> Any:
    """What a forked child gets from using what it has of its parent's."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            data = pickle.dumps(seeded(use, thing))
        except BaseException as error:
            data = pickle.dumps(f"{type(error).__name__}: {error}")
        with os.fdopen(writer, "wb") as file:
            file.write(data)
        os._exit(0)
    os.close(writer)
    with os.fdopen(reader, "rb") as file:
        answers, _, _ = select.select([file], [], [], LIMIT)
        data = file.read() if answers else b""
    if not data:
        os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return pickle.loads(data) if data else "it hangs"


def serve(connection: Any) -> None:
    """Use what comes, in a spawned process, until nothing does."""
    while (message := connection.recv()) is not None:
        name, thing = message
        try:
            answer = pickle.dumps(seeded(THINGS[name][1], thing))
        except BaseException as error:
            answer = pickle.dumps(f"{type(error).__name__}: {error}")
        connection.send_bytes(answer)


def main(way: str) -> dict[str, str]:
    """Compare each thing with what another process has of it."""
    verdicts = {}
    here, there = multiprocessing.get_context("spawn").Pipe()
    if way == "spawn":
        other = multiprocessing.get_context("spawn").Process(target=serve, args=(there,))
        other.start()
    for name, (make, use) in THINGS.items():
        th.set_num_threads(2 if name == "GoalPredictor" else 1)
        thing = seeded(make)
        seeded(use, thing)  # whatever is made when it is first used, threads above all, is there
        if way == "fork":
            theirs = used_in_a_fork(thing, use)
        else:
            here.send((name, thing))
            theirs = pickle.loads(here.recv_bytes()) if here.poll(LIMIT) else "it hangs"
        ours = seeded(use, thing)
        verdicts[name] = "equal" if equal(ours, theirs) else f"{theirs!s:.300}"
    if way == "spawn":
        here.send(None)
        other.join(LIMIT)
        other.kill()
    return verdicts


if __name__ == "__main__":
    os.chdir(tempfile.mkdtemp())
    Path("verdicts.json").write_text(json.dumps(main(sys.argv[1])))
    print(Path("verdicts.json").read_text())
