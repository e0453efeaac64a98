"""What pictures show: nothing solid before what matters, and levels by their colours."""

from __future__ import annotations

from typing import Any
from unittest.mock import MagicMock

import gymnasium as gym
import mujoco
import numpy as np
import pytest

from sb3_follow_object.command import demo
from sb3_follow_object.command.cli import main
from sb3_follow_object.envs import TASKS, picture
from sb3_follow_object.envs.scene import GRIP_SITE, OBJECT

EPISODES = 20


def share_seen(task: str) -> float:
    """Of gripper, object, goal and the way between what no solid thing hides at the starts."""
    env = gym.make(f"FollowObject/{task}-v0").unwrapped
    model = picture.whole_model(env.simulation.scene)
    model.geom_rgba[model.geom_rgba[:, 3] < 1.0, 3] = 0.0  # rays pass what is seen through
    data, camera = mujoco.MjData(model), mujoco.MjvCamera()
    picture._point(camera)
    azimuth, elevation = np.radians([camera.azimuth, camera.elevation])
    along = np.cos(elevation)
    forward = np.array([along * np.cos(azimuth), along * np.sin(azimuth), np.sin(elevation)])
    eye = camera.lookat - camera.distance * forward
    seen = []
    for seed in range(EPISODES):
        obs, _ = env.reset(seed=seed)
        picture._copy_state(env.simulation, 0, model, data)
        line = np.linspace(obs["achieved_goal"], obs["desired_goal"], 15)
        for point in (data.site(GRIP_SITE).xpos, *line):
            way = np.asarray(point) - eye
            length, hit = np.linalg.norm(way), np.zeros(1, dtype=np.int32)
            own = model.body(OBJECT).id
            reached = mujoco.mj_ray(model, data, eye, way / length, None, 1, own, hit)
            seen.append(reached < 0 or reached > length - 0.03)  # its own surface
    env.close()
    return float(np.mean(seen))


@pytest.mark.parametrize("task", TASKS)
def test_gripper_object_and_goal_are_not_hidden(task: str) -> None:
    # The arm hides up to 0.07; from the side, and with solid walls, up to 0.8 of a way was hidden.
    assert share_seen(task) >= 0.9


def test_markers_go_from_dark_to_yellow_by_level() -> None:
    colours = picture.marker_colours(25)
    assert colours.shape == (25, 3)
    brightness = colours.sum(axis=1)
    assert (np.diff(brightness) > 0).all()
    np.testing.assert_allclose(colours[[0, -1]], picture._MARKER_RGB[[0, -1]])
    assert picture.marker_colours(0).shape == (0, 3)


@pytest.mark.usefixtures("can_draw")
def test_robot_is_seen_through_while_markers_are_shown() -> None:
    env = gym.make("FollowObject/PnPShelf-v0", render_mode="rgb_array").unwrapped
    env.reset(seed=0)
    solid = env.render()
    env.set_markers(np.array([[1.3, 0.75, 0.0]]))  # under the table, seen from nowhere
    through = env.render()
    env.set_markers(np.zeros((0, 3)))
    assert (env.render() == solid).all()
    env.close()
    upper_middle = (slice(0, 160), slice(200, 280))  # where the arm is
    assert (through[upper_middle] != solid[upper_middle]).any(axis=-1).mean() > 0.3
    assert (through[320:] == solid[320:]).all()  # the table's front


class Viewer:
    """In place of mujoco.viewer, where there is no screen."""

    def __init__(self) -> None:
        self.panels: dict[str, bool] = {}
        self.running = True

    def launch_passive(self, model: Any, data: Any, **panels: bool) -> MagicMock:
        self.panels = panels
        handle = MagicMock(cam=mujoco.MjvCamera(), user_scn=mujoco.MjvScene(model, 1000))
        handle.is_running.side_effect = lambda: self.running
        return handle


@pytest.fixture
def viewer(monkeypatch: pytest.MonkeyPatch) -> Viewer:
    one = Viewer()
    monkeypatch.setattr(picture, "check_windows", lambda: None)
    monkeypatch.setattr(picture, "import_module", lambda name: one)
    return one


def test_window_shows_the_robot_and_not_the_viewers_panels(viewer: Viewer) -> None:
    env = gym.make("FollowObject/PnPShelf-v0", render_mode="human")
    env.reset(seed=0)
    env.close()
    assert viewer.panels == {"show_left_ui": False, "show_right_ui": False}


def test_closing_the_window_is_noticed_and_ends_the_demo(
    viewer: Viewer, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    env = gym.make("FollowObject/PnPShelf-v0", render_mode="human")
    assert not env.unwrapped.window_closed  # there is none yet
    env.reset(seed=0)
    assert not env.unwrapped.window_closed
    viewer.running = False
    env.step(env.action_space.sample())
    assert env.unwrapped.window_closed
    env.close()
    monkeypatch.setattr(demo, "_has_window", lambda: True)
    assert main(["demo", "--episodes", "3"]) == 0
    assert capsys.readouterr().out.splitlines()[1:] == ["the window was closed"]
