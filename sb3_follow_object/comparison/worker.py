"""One job of a comparison: an object stage, a run, or a policy's test on another task.

`python -m sb3_follow_object.comparison.worker` does the job that the first line of standard input
describes and tells how it goes in lines of JSON on standard output; whatever else is printed goes
to standard error. It stops, with a checkpoint, when standard input ends: nobody waits for it then.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ..common.reports import Trouble, named_reason

STAGE, TRAIN, CROSS = "stage", "train", "cross"
FAILURE, INTERRUPTED = 1, 130

Send = Callable[[dict[str, Any]], None]


@dataclass(frozen=True)
class Job:
    """What a worker is to do, in a folder that holds a config.json already.

    Attributes:
        kind: STAGE learns what the object stage teaches, TRAIN trains or resumes the run, CROSS
            tests its policy on another task.
        name: of the job, unique in a grid.
        folder: of the run or of the stage.
        threads: cores that the job may use, >= 1.
        command: the command line to note in the run's result.
        other: id of the other task, of a CROSS.
    """

    kind: str
    name: str
    folder: str
    threads: int = 1
    command: str = ""
    other: str = ""

    def to_json(self) -> str:
        """Return the job as one line."""
        return json.dumps(asdict(self))


def run_job(job: Job, send: Send) -> None:
    """Do a job in this process.

    Args:
        job: what to do.
        send: called with {"figures": ...} after each rollout, and with {"say": ...} or
            {"trouble": ...} now and then.

    Raises:
        KeyboardInterrupt: it was stopped; a run has written its checkpoint.
    """
    from ..runs.experiment import train
    from ..settings.presets import load_config
    from .cross import cross_test

    folder = Path(job.folder)

    def say(sentence: str) -> None:
        print(sentence, file=sys.stderr, flush=True)
        kind = "trouble" if isinstance(sentence, Trouble) else "say"
        send({kind: sentence.strip()})

    if job.kind == CROSS:
        cross_test(folder, job.other)
        return
    train(
        load_config(folder),
        folder,
        resume=True,
        report=say,
        progress=lambda figures: send({"figures": figures}),
        command=job.command,
        object_stage_only=job.kind == STAGE,
        wait=True,  # for the job of a comparison that was killed to write its checkpoint
    )


def main() -> int:
    """Do the job on standard input; return 0, 1 when it failed, 130 when it was stopped."""
    job = Job(**json.loads(sys.stdin.readline()))
    threading.Thread(target=_stop_when_alone, daemon=True).start()
    # The lines of JSON get the pipe for themselves: libraries print where they like.
    out = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)

    def send(message: dict[str, Any]) -> None:
        with suppress(OSError):  # whoever started it is gone, which the thread above has noticed
            out.write(json.dumps(message) + "\n")

    try:
        run_job(job, send)
    except KeyboardInterrupt:
        return INTERRUPTED
    except Exception as error:
        traceback.print_exc()
        send({"failed": named_reason(error)})
        return FAILURE
    return 0


def _stop_when_alone() -> None:
    """Wait until nobody holds the other end of standard input, then stop this process."""
    while os.read(0, 1):  # not sys.stdin, whose lock a thread must not hold when Python ends
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    sys.exit(main())
