"""Seeds of the random streams of a run."""

from __future__ import annotations

import numpy as np

from .numbers import checked_whole


def stream_seed(seed: int, purpose: str) -> int:
    """Return the seed of one random stream of a run, below 2**31 - 1000.

    Args:
        seed: the run's seed, >= 0.
        purpose: any name; different names give unrelated streams.

    Raises:
        ValueError: the seed is negative or no whole number.
    """
    words = [checked_whole("seed", seed, 0), *purpose.encode()]
    return int(np.random.SeedSequence(words).generate_state(1)[0]) % (2**31 - 1000)
