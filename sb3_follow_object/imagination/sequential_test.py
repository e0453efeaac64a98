"""Whether a level is mastered, by all of its tests together rather than by one that went well."""

from __future__ import annotations

import math

# Rates, in thresholds, between which the test decides; 0.1 and 0.5 for the paper's 0.25.
_TOO_LOW, _ENOUGH = 0.4, 2.0
_DECISION = math.log(100.0)  # what is likelier by so much is believed


class SequentialTest:
    """Adds up tests of one level until its success rate is enough beyond doubt.

    The logarithm of how much likelier the outcomes are at a rate that is enough than at one that is
    too low is added up, never below 0, so that failures of long ago do not count (Page's cumulative
    sum, 1954, of Wald's ratio, 1945). At a threshold of 0.25 seven successes of 16 decide at once,
    five and six in two tests in a row, and four of 16 each time never do.

    Attributes:
        evidence: so far, >= 0.
    """

    def __init__(self) -> None:
        self.evidence = 0.0

    def passes(self, success_rate: float, n_episodes: int, threshold: float) -> bool:
        """Take in a test; return whether the level is mastered, which begins the next one's.

        Args:
            success_rate: share of the test's episodes, in [0, 1].
            n_episodes: of the test, >= 1.
            threshold: success rate that is wanted, in [0, 1].
        """
        enough = min(_ENOUGH * threshold, 0.5 * (1.0 + threshold), 0.99)
        too_low = min(_TOO_LOW * threshold, 0.9 * enough)
        if threshold > 0.0:
            gain = success_rate * math.log(enough / too_low)
            loss = (1.0 - success_rate) * math.log((1.0 - too_low) / (1.0 - enough))
            self.evidence = max(0.0, self.evidence + n_episodes * (gain - loss))
            if self.evidence < _DECISION:
                return False
        self.evidence = 0.0
        return True
