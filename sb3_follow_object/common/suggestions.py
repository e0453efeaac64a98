"""What may have been meant by a word that nothing has."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def did_you_mean(word: str, known: Iterable[object]) -> str:
    """The end of a sentence about an unknown name: the nearest known one, else all of them."""
    names = [str(name) for name in known]
    near = difflib.get_close_matches(str(word), names, n=1, cutoff=0.4)
    return f"; did you mean {near[0]!r}?" if near else f"; known are {', '.join(names)}"
