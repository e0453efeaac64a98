"""Mutate artifacts and settings, and see that each loads or is refused in one sentence.

    python benchmarks/fuzz.py --out benchmarks/fuzz.json

Predictors, policies, checkpoints, run configurations and YAML files are changed at random: bits,
bytes, pieces cut out, doubled or swapped, numbers made huge, nesting made deep, checksums made to
fit again, so that what lies behind them is reached. Each must load or raise a ValueError of one
line, within a time, within a memory and without a file written. A crash of the process, such as
running out of memory, ends the fuzzing with an error.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import random
import resource
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import FrameType

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.td3.policies import Actor

from sb3_follow_object.common.array_trees import load_tree, save_tree
from sb3_follow_object.ddpg.actor_files import load_actor, save_actor
from sb3_follow_object.ddpg.policies import NormalizedGoalExtractor
from sb3_follow_object.imagination.goal_predictor import GoalPredictor
from sb3_follow_object.imagination.predictor_files import FACTS_FILE, TENSORS_FILE
from sb3_follow_object.runs.run_folder import CONFIG
from sb3_follow_object.settings.presets import load_config, preset_file, run_config

TASK = "FollowObject/PushSideGap-v0"
SECONDS = 20  # a load may take on a busy machine
MEMORY = 1 << 30  # bytes that a load may take beyond what the process had
WORDS = [b"99999999999", b"-1", b"1e309", b"null", b"NaN", b"true", b"[]", b"{}", b'""', b"0"]
WORDS += [b"[" * 5000, b'{"a":' * 3000, b"&a [*a]", b"<<: *a\n", b"!!python/name:os.system x"]
WORDS += [b"!!binary aGk=", b"2020-01-01", b"../../../etc/passwd", b"\x00", b"\xff\xfe", b"\n- "]
BOMB = "a: &a {x: 1}\n" + "\n".join(
    f"b{n}: &b{n} [{', '.join(f'*{before}' for _ in range(9))}]"
    for n, before in enumerate(["a", *(f"b{i}" for i in range(9))])
)
MERGE_BOMB = "\n".join(
    ["a: &a {x: 1}"]
    + [
        f"m{n}: &m{n}\n  <<: [{', '.join(f'*{before}' for _ in range(9))}]"
        for n, before in enumerate(["a", *(f"m{i}" for i in range(9))])
    ]
)

Load = Callable[[], object]
Mutate = Callable[[bytes, random.Random], bytes]


# ---- mutations --------------------------------------------------------------------------------


def flip(data: bytes, rng: random.Random) -> bytes:
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 3, 30))):
        out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    return bytes(out)


def cut(data: bytes, rng: random.Random) -> bytes:
    start = rng.randrange(len(data) + 1)
    return data[:start] + data[start + rng.choice((1, 8, 100, len(data))) :]


def double(data: bytes, rng: random.Random) -> bytes:
    start, end = sorted(rng.randrange(len(data) + 1) for _ in range(2))
    return data[:end] + data[start:end] * rng.choice((1, 2, 20)) + data[end:]


def insert(data: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(data) + 1)
    return data[:at] + rng.choice(WORDS) + data[at + rng.choice((0, 1, 4)) :]


def replace_word(data: bytes, rng: random.Random) -> bytes:
    """Put something else where a number or a name stands."""
    marks = [i for i in range(1, len(data)) if data[i - 1 : i] in (b" ", b":", b"[", b",")]
    if not marks:
        return insert(data, rng)
    at = rng.choice(marks)
    end = at
    while end < len(data) and data[end : end + 1] not in (b",", b"]", b"}", b"\n", b":"):
        end += 1
    return data[:at] + rng.choice(WORDS) + data[end:]


MUTATIONS: tuple[Mutate, ...] = (flip, cut, double, insert, replace_word)


def mutated(data: bytes, rng: random.Random) -> bytes:
    for _ in range(rng.choice((1, 1, 2, 4))):
        data = rng.choice(MUTATIONS)(data, rng) or b"\x00"
    return data


def mutated_tree(data: bytes, rng: random.Random) -> bytes:
    """Mutate a checkpoint; often its header alone, or with a checksum that fits again."""
    how = rng.random()
    if how < 0.3:
        return mutated(data, rng)
    size = int.from_bytes(data[:8], "little")
    header, rest = data[8 : 8 + size], data[8 + size :]
    if how < 0.8:
        header = mutated(header, rng)
        length = len(header) if rng.random() < 0.9 else rng.choice((0, 1 << 62, len(data) * 2))
        data = (length % (1 << 64)).to_bytes(8, "little") + header + rest
    else:
        data = data[: 8 + size] + mutated(rest or b"\x00", rng)
    begin = b'{"__metadata__":{"sha256":"'
    if data[8:].startswith(begin):
        at = 8 + len(begin)
        zeroed = data[:at] + b"0" * 64 + data[at + 64 :]
        data = data[:at] + hashlib.sha256(zeroed).hexdigest().encode() + data[at + 64 :]
    return data


# ---- targets ----------------------------------------------------------------------------------


class Targets:
    """Small whole artifacts, and how each kind is loaded."""

    def __init__(self, folder: Path):
        self.folder = folder
        rng = np.random.default_rng(0)
        start, goal = rng.uniform(0.4, 1.4, (2, 8, 3))
        share = np.linspace(0.0, 1.0, 6)[:, None]
        paths = start[:, None] + share * (goal - start)[:, None]
        facts = {"env_id": TASK, "physics": "0" * 12, "object_on_table": True}
        GoalPredictor.fit(paths, goal, hidden=(4,), epochs=1, **facts).save(folder)
        sizes = {"observation": 25, "achieved_goal": 3, "desired_goal": 3}
        box = {key: spaces.Box(-np.inf, np.inf, (size,)) for key, size in sizes.items()}
        self.spaces = spaces.Dict(box), spaces.Box(-1.0, 1.0, (4,))
        extractor = NormalizedGoalExtractor(self.spaces[0])
        actor = Actor(*self.spaces, [4], extractor, extractor.features_dim)
        save_actor(folder / "policy.safetensors", actor, TASK)
        tree = {"a": np.arange(4), "b": (1, [th.ones(2)], {3: None}), "c": np.zeros((0, 2), bool)}
        save_tree(folder / "tree.safetensors", tree)
        config = {"env_id": TASK, "method": "fo", "seed": 1, "total_timesteps": 100}
        config |= {"settings": {"n_envs": 2, "algorithm": {"train_freq": [1, "episode"]}}}
        (folder / CONFIG).write_text(json.dumps(config, indent=1))
        own = f"{TASK}: &a\n  n_envs: 2\n  policy_kwargs: {{net_arch: [8, 8]}}\n"
        own += "  env_wrapper:\n  - sb3_follow_object.ImaginedGoalWrapper: {curriculum: {p: 0.5}}\n"
        own += "  train_freq: [1, episode]\n  callback: sb3_follow_object.CurriculumCallback\n"
        self.seeds: dict[str, list[bytes]] = {
            FACTS_FILE: [(folder / FACTS_FILE).read_bytes()],
            TENSORS_FILE: [(folder / TENSORS_FILE).read_bytes()],
            "policy.safetensors": [(folder / "policy.safetensors").read_bytes()],
            "tree.safetensors": [(folder / "tree.safetensors").read_bytes()],
            CONFIG: [(folder / CONFIG).read_bytes()],
            "settings.yml": [
                own.encode(),
                own.encode(),
                preset_file("her").read_bytes(),
                BOMB.encode(),
                MERGE_BOMB.encode(),
            ],
        }
        for name, seeds in self.seeds.items():
            (folder / name).write_bytes(seeds[0])
        self.loads: dict[str, Load] = {
            FACTS_FILE: lambda: GoalPredictor.load(folder),
            TENSORS_FILE: lambda: GoalPredictor.load(folder),
            "policy.safetensors": lambda: load_actor(folder / "policy.safetensors", *self.spaces),
            "tree.safetensors": lambda: load_tree(folder / "tree.safetensors"),
            CONFIG: lambda: load_config(folder),
            "settings.yml": lambda: run_config(TASK, file=folder / "settings.yml"),
        }

    def mutate(self, name: str, rng: random.Random) -> bytes:
        data = rng.choice(self.seeds[name])
        if name in (TENSORS_FILE, "policy.safetensors", "tree.safetensors"):
            data = mutated_tree(data, rng)
        elif rng.random() < 0.95 or data == self.seeds[name][0]:
            data = mutated(data, rng)  # the bombs also as they are
        return data

    def put(self, name: str, data: bytes) -> None:
        """Write a mutated file; tensors get a description with the digest that fits them."""
        (self.folder / name).write_bytes(data)
        if name == TENSORS_FILE:
            facts = json.loads(self.seeds[FACTS_FILE][0])
            facts["sha256"] = hashlib.sha256(data).hexdigest()
            (self.folder / FACTS_FILE).write_text(json.dumps(facts))

    def restore(self, name: str) -> None:
        for file in {name, FACTS_FILE}:
            (self.folder / file).write_bytes(self.seeds[file][0])


class TooSlow(BaseException):
    """A load took longer than `SECONDS`; no `except Exception` swallows it."""


def _too_slow(signum: int, frame: FrameType | None) -> None:
    raise TooSlow


def try_load(load: Load) -> tuple[str, str]:
    """Return "loaded", "refused" or what went wrong, and the sentence."""
    signal.alarm(SECONDS)
    try:
        load()
        return "loaded", ""
    except ValueError as error:
        sentence = str(error)
        return ("refused" if sentence and "\n" not in sentence else "not one line"), sentence
    except TooSlow:
        return "too slow", ""
    except BaseException as error:
        return f"raised {type(error).__name__}", str(error)
    finally:
        signal.alarm(0)


def fuzz(n: int, seed: int) -> dict[str, object]:
    """Try n mutated files and return how often each outcome was met, and the bad ones."""
    rng = random.Random(seed)
    outcomes: Counter[str] = Counter()
    bad: list[dict[str, str]] = []
    slowest = 0.0
    signal.signal(signal.SIGALRM, _too_slow)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "artifacts"
        folder.mkdir()
        targets = Targets(folder)
        for load in targets.loads.values():
            load()  # whole, each loads; and what is imported late is imported now
        with open("/proc/self/statm") as file:
            size = int(file.read().split()[0]) * resource.getpagesize()
        limits = resource.getrlimit(resource.RLIMIT_AS)
        resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY, limits[1]))
        before = sorted(Path(name).rglob("*"))
        names = list(targets.loads)
        for number in range(n):
            target = names[number % len(names)]
            data = targets.mutate(target, rng)
            targets.put(target, data)
            began = time.monotonic()
            outcome, sentence = try_load(targets.loads[target])
            slowest = max(slowest, time.monotonic() - began)
            if sorted(Path(name).rglob("*")) != before:
                outcome = "wrote a file"
            targets.restore(target)
            outcomes[f"{target}: {outcome}"] += 1
            if outcome not in ("loaded", "refused"):
                bad.append({"file": target, "outcome": outcome, "sentence": sentence[:300]})
                bad[-1]["data"] = data[:400].hex()
        resource.setrlimit(resource.RLIMIT_AS, limits)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return {
        "files": n,
        "seed": seed,
        "outcomes": dict(sorted(outcomes.items())),
        "slowest_s": round(slowest, 2),
        "peak_resident_mb": round(peak / 1e6),
        "bad": bad,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--files", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="JSON file for what was found")
    args = parser.parse_args()
    found = fuzz(args.files, args.seed)
    text = json.dumps(found, indent=1)
    print(text)
    if args.out is not None:
        args.out.write_text(text + "\n")
    return 1 if found["bad"] else 0


if __name__ == "__main__":
    sys.exit(main())
