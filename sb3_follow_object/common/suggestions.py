"""What may have been meant by a word that nothing has."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

_MOST = 60  # names in a sentence; gymnasium knows hundreds of ids
_ALIKE = 0.6  # difflib's ratio, below which two words have little more than letters in common


def did_you_mean(word: str, known: Iterable[object]) -> str:
    """The end of a sentence about an unknown name: the nearest known one, else all of them.

    An environment's id is found without its namespace, too.
    """
    names = list(dict.fromkeys(map(str, known)))
    whole = {name.rpartition("/")[2]: name for name in names} | {name: name for name in names}
    near = difflib.get_close_matches(str(word), whole, n=1, cutoff=_ALIKE)
    if near:
        return f"; did you mean {whole[near[0]]!r}?"
    more = f" and {len(names) - _MOST} more" if len(names) > _MOST else ""
    return f"; known are {', '.join(names[:_MOST])}{more}"
