"""Which OpenGL library draws here: each is tried in a process of its own before this one takes it.

A library that does not work may end the process that loads it, and one that a process has loaded
is in the way of the next. So nothing that the surroundings say (MUJOCO_GL, DISPLAY) is believed.
"""

from __future__ import annotations

import logging
import os
import re
import signal
import subprocess
import sys
from functools import cache
from importlib import import_module
from typing import Any

from ..common.reports import reason

_LOGGER = logging.getLogger("sb3_follow_object")
WINDOWS = "glfw"  # the library that opens windows, and draws where there is a screen
_OFF_SCREEN = ("egl", "osmesa")
# What mujoco takes MUJOCO_GL for, after lowering it and stripping blanks.
_UNDECIDED = ("", "enable", "enabled", "on", "true", "1")
_FORBIDDEN = ("disable", "disabled", "off", "false", "0")
_OTHER_NAMES = {"glx": WINDOWS, "wgl": WINDOWS}

# What a trial's outcome hangs on besides the library.
_SURROUNDINGS = (
    "DISPLAY",
    "WAYLAND_DISPLAY",
    "XAUTHORITY",
    "XDG_RUNTIME_DIR",
    "MUJOCO_EGL_DEVICE_ID",
    "PYOPENGL_PLATFORM",
    "LD_LIBRARY_PATH",
)
_TRIAL_SECONDS = 60.0
_TRIAL = """
import importlib, os, mujoco
importlib.import_module("mujoco." + os.environ["MUJOCO_GL"])  # says what mujoco hides
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
renderer = mujoco.Renderer(model, 8, 8)
renderer.update_scene(data)
assert renderer.render().any(), "its pictures are black"
renderer.close()
"""


def open_graphics(size: int) -> tuple[str, Any]:
    """Name and context of the library that `find_graphics` finds.

    Args:
        size: width and height of the context's pictures, pixels.

    Raises:
        RuntimeError: none works.
    """
    library = find_graphics()
    platform = os.environ.get("PYOPENGL_PLATFORM")
    try:
        return library, import_module(f"mujoco.{library}").GLContext(size, size)
    except Exception as error:  # each library fails with errors of its own
        forget_opengl(platform)
        raise RuntimeError(
            f"{library} draws in a process of its own, but not in this one ({reason(error)}); "
            "another OpenGL library may be loaded here already."
        ) from error


def find_graphics() -> str:
    """The library that MUJOCO_GL names, or else the first that works: a screen's, egl, osmesa.

    Raises:
        RuntimeError: the named one does not work, drawing is switched off, or none works.
    """
    given = os.environ.get("MUJOCO_GL", "")
    named = given.strip().lower()
    if named in _FORBIDDEN:
        raise RuntimeError(f"MUJOCO_GL={given} switches drawing off; unset it to draw.")
    if named not in _UNDECIDED:
        return _named_library(given, _OTHER_NAMES.get(named, named))
    failed: dict[str, str] = {}
    for library in _candidates():
        why = why_not(library)
        if why is None:
            for other, its in failed.items():
                _note_once(f"{other} does not draw here ({its}); drawing with {library}")
            return library
        failed[library] = why
    listed = "; ".join(f"{library}: {why}" for library, why in failed.items())
    raise RuntimeError(
        f"There is no OpenGL to draw with ({listed}); "
        "install libegl1 and libegl-mesa0, or libosmesa6."
    )


def _named_library(given: str, library: str) -> str:
    why = why_not(library)
    if why is None:
        return library
    others = (other for other in _candidates() if other != library)
    working = next((other for other in others if why_not(other) is None), None)
    way_out = "no other library does either"
    if working is not None:
        way_out = f"{working} does: set MUJOCO_GL={working} or unset it"
    raise RuntimeError(f"MUJOCO_GL={given} does not draw here ({why}); {way_out}.")


def check_windows() -> None:
    """Raise a RuntimeError unless a window can be opened: one without a screen ends the process."""
    if sys.platform != "linux":
        return
    why = why_not(WINDOWS)
    if why is not None:
        raise RuntimeError(
            f"No window can be opened here ({why}); use render_mode='rgb_array', or a screen."
        )


def why_not(library: str) -> str | None:
    """Why a library does not draw here; None if it does. Found out once in a process."""
    if not library.isidentifier():
        return "it is no library of mujoco's"
    try:
        return _try(library, tuple(os.environ.get(name) for name in _SURROUNDINGS))
    except OSError as error:  # of this moment, and not kept
        return f"it cannot be tried: {reason(error)}"


@cache
def _try(library: str, surroundings: tuple[str | None, ...]) -> str | None:
    del surroundings  # of the environment, which the trial inherits
    env = {
        **os.environ,
        "MUJOCO_GL": library,
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
    }
    try:
        trial = subprocess.run(
            [sys.executable, "-c", _TRIAL],
            env=env,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=_TRIAL_SECONDS,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"it has drawn nothing in {_TRIAL_SECONDS:.0f} s"
    if trial.returncode == 0:
        return None
    lines = [line.strip() for line in trial.stderr.splitlines() if line.strip()]
    # GLFW says what is wrong in its first warning, the others in the error at the end.
    said = re.search(r"GLFWError: \(\d+\) b'(.*)'", trial.stderr)
    if said:
        return said[1]
    if trial.returncode < 0:
        return f"it ends the process by {signal.Signals(-trial.returncode).name}"
    return lines[-1] if lines else f"exit status {trial.returncode}"


def _candidates() -> list[str]:
    if sys.platform == "darwin":
        return ["cgl", WINDOWS]
    if sys.platform == "win32":
        return [WINDOWS]
    has_screen = {"DISPLAY", "WAYLAND_DISPLAY"} & {name for name in os.environ if os.environ[name]}
    return [WINDOWS, *_OFF_SCREEN] if has_screen else [*_OFF_SCREEN]


@cache
def _note_once(sentence: str) -> None:
    _LOGGER.warning(sentence)


def forget_opengl(platform: str | None) -> None:
    """Forget an OpenGL that failed while it was imported: what is loaded of it is bound to it.

    Args:
        platform: what PYOPENGL_PLATFORM was before.
    """
    os.environ.pop("PYOPENGL_PLATFORM", None)
    if platform is not None:
        os.environ["PYOPENGL_PLATFORM"] = platform
    for name in list(sys.modules):
        if name.partition(".")[0] == "OpenGL" or name.startswith(("mujoco.egl", "mujoco.osmesa")):
            del sys.modules[name]
