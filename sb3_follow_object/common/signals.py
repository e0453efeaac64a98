"""SIGINT and SIGTERM, which ask a program to end where nothing is lost."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def stop_signals_to(request: Callable[[], None]) -> Iterator[None]:
    """Call `request` on SIGINT and SIGTERM for a while.

    Off the main thread, where Python delivers no signals, nothing is called and nothing is changed.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def handle(signum: int, frame: Any) -> None:
        request()

    earlier = {sig: signal.signal(sig, handle) for sig in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for sig, handler in earlier.items():
            # None stands for one that was not installed from Python, which has no other name.
            signal.signal(sig, signal.SIG_DFL if handler is None else handler)
