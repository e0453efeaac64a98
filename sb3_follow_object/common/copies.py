"""What copy and pickle may do with what a process holds: copy it whole, or refuse in a sentence."""

from __future__ import annotations

import copy
from typing import Any, NoReturn


class WholeCopies:
    """copy.copy copies it as copy.deepcopy does: two of it must not share what only one can use."""

    def __copy__(self) -> Any:
        return copy.deepcopy(self)


class NoCopies:
    """Refuses to be copied or pickled.

    Attributes:
        no_copies: the sentence that says why, and what to do instead.
    """

    no_copies: str

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        raise ValueError(self.no_copies)
