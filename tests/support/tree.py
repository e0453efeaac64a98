"""Where the packages lie in this tree, and how tests run commands on it."""

import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = {
    "sb3_follow_object": ROOT / "sb3_follow_object",
    "sb3_follow_object/envs": ROOT / "envs",
    "sb3_follow_object/zoo_configs": ROOT / "zoo_configs",
}


def run(command: list[str], **options: object) -> str:
    """Runs a command; its output becomes the failure's message."""
    done = subprocess.run(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False, **options
    )
    assert done.returncode == 0, f"{' '.join(command)}\n{done.stdout}"
    return str(done.stdout)
