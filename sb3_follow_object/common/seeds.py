"""Seeds of the random streams of a run."""

from __future__ import annotations

import numpy as np


def stream_seed(seed: int, purpose: str) -> int:
    """Return the seed of one random stream of a run, below 2**31 - 1000.

    Args:
        seed: the run's seed, >= 0.
        purpose: any name; different names give unrelated streams.

    Raises:
        ValueError: the seed is negative.
    """
    if seed < 0:
        raise ValueError(f"seed is {seed}; it must be at least 0")
    words = [seed, *purpose.encode()]
    return int(np.random.SeedSequence(words).generate_state(1)[0]) % (2**31 - 1000)
