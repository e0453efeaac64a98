"""Puts the policies of finished runs into the package, for `sb3-follow-object demo`.

    python benchmarks/demo_policies.py                  # seed 0 of FO, of benchmarks/results
    python benchmarks/demo_policies.py runs/shelf ...   # of these runs' tasks

They are the runs' policy.safetensors as they are: actor and normaliser, without pickle.
"""

import argparse
import shutil
import sys
from pathlib import Path

from sb3_follow_object.command.demo import POLICIES
from sb3_follow_object.ddpg.actor_files import load_actor
from sb3_follow_object.envs import TASKS, make_vec
from sb3_follow_object.runs.run_folder import POLICY, read_result
from sb3_follow_object.settings.presets import load_config

RESULTS = Path(__file__).parent / "results"
MOST_BYTES = 6_000_000  # of all together


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    runs = [RESULTS / f"{task}-fo-0" for task in TASKS]
    results = [run for run in runs if (run / POLICY).exists()]
    parser.add_argument("runs", type=Path, nargs="*", default=results, metavar="RUN")
    POLICIES.mkdir(exist_ok=True)
    for run in parser.parse_args().runs:
        env_id = load_config(run).env_id
        env = make_vec(env_id, 1)
        load_actor(run / POLICY, env.observation_space, env.action_space)
        env.close()
        name = env_id.removeprefix("FollowObject/").removesuffix("-v0")
        shutil.copyfile(run / POLICY, POLICIES / f"{name}.safetensors")
        print(f"{name}: success {read_result(run)['success_rate']:.3f}, from {run}")
    size = sum(file.stat().st_size for file in POLICIES.iterdir())
    print(f"{size:,} bytes together, at most {MOST_BYTES:,}")
    return int(size > MOST_BYTES)


if __name__ == "__main__":
    sys.exit(main())
