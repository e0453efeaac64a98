"""mujoco, imported also where MUJOCO_GL names a library that is not there: physics needs none."""

from __future__ import annotations

import os

from .graphics import forget_opengl

_platform = os.environ.get("PYOPENGL_PLATFORM")
try:
    import mujoco
except Exception:  # a library that is missing fails with errors of its own
    _named = os.environ.get("MUJOCO_GL")
    if not _named:
        raise
    forget_opengl(_platform)
    os.environ["MUJOCO_GL"] = "off"
    try:
        import mujoco
    finally:
        os.environ["MUJOCO_GL"] = _named  # who draws is told what is wrong with it

__all__ = ["mujoco"]
