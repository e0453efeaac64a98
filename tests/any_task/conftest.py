"""What tests of tasks of others share."""

from __future__ import annotations

from pathlib import Path

import pytest

from sb3_follow_object.any_task import derived as module
from sb3_follow_object.common.cache import CACHE_VARIABLE


@pytest.fixture
def few_resets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is known of any task yet, and 60 resets are recorded of one."""
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    monkeypatch.setattr(module, "N_RESETS", 60)
    monkeypatch.setattr(module, "_LOOKED_AT", {})
