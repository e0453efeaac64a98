"""The tasks' figures, written down a second time, against what the scenes and samplers give."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sb3_follow_object.envs import TASKS, Height, ObjectEnv, Region
from sb3_follow_object.envs.scene import fetch_scene, object_scene

SIDE = ((0.0, 0.075, 0.25), (0.175, 0.0125, 0.05))
AROUND, NEAR = (-0.15, 0.15, -0.15, 0.15), (-0.15, 0.15, -0.15, 0.05)
FAR, TABLE = (-0.15, 0.15, 0.125, 0.25), (-0.225, 0.225, -0.325, 0.325)


def pair(x: float, y: float) -> list[Any]:
    return [((side * x, y, 0.25), (0.10625, 0.0125, 0.05)) for side in (-1, 1)]


# reference, start and goal (x low, x high, y low, y high), height (low, high, chance), T, obstacles
FIGURES: dict[str, tuple[Any, ...]] = {
    "PnPSimpleV1": ("gripper", AROUND, AROUND, (0.0, 0.45, 0.5), 50, []),
    "PnPSimpleV2": ("table", TABLE, TABLE, (0.05, 0.45, 1.0), 50, []),
    "PushSideGap": ("gripper", NEAR, FAR, (0.0, 0.0, 0.0), 50, [SIDE]),
    "PushMiddleGap": ("gripper", NEAR, FAR, (0.0, 0.0, 0.0), 50, pair(0.14375, 0.075)),
    "PushDoubleObstacles": (
        "gripper",
        (-0.15, 0.15, -0.25, -0.15),
        FAR,
        (0.0, 0.0, 0.0),
        80,
        [SIDE, *pair(0.14375, -0.125)],
    ),
    "PnPObstacle": (
        "gripper",
        NEAR,
        FAR,
        (0.0, 0.45, 0.5),
        50,
        [((0.0, 0.075, 0.30), (0.25, 0.0125, 0.10))],
    ),
    "PnPShelf": (
        "gripper",
        NEAR,
        FAR,
        (0.2, 0.2, 1.0),
        50,
        [((0.0, 0.2125, 0.30), (0.25, 0.1375, 0.10))],
    ),
    "PnPInsertion": ("gripper", AROUND, AROUND, (0.0, 0.0, 0.0), 50, []),
}
TUBE = [((s * 0.05125, 0.0, 0.05), (0.02375, 0.075, 0.05)) for s in (1, -1)]
TUBE += [((0.0, s * 0.05125, 0.05), (0.0275, 0.02375, 0.05)) for s in (1, -1)]


@pytest.mark.parametrize("name", FIGURES)
def test_scene_has_the_figures(name: str) -> None:
    *_, horizon, obstacles = FIGURES[name]
    task = TASKS[name]
    assert (task.horizon, task.blocked_gripper) == (horizon, name.startswith("Push"))
    tube = TUBE if name == "PnPInsertion" else []
    friction = (1.0, 1.0, 1.0) if name == "PnPObstacle" else (1.0, 0.005, 0.0001)
    for model in (fetch_scene(task).model, object_scene(task).model):
        for kind, wanted in (("obstacle", obstacles), ("tube", tube)):
            geoms = [geom for geom in map(model.geom, range(model.ngeom)) if kind in geom.name]
            found = [(*geom.pos, *geom.size) for geom in geoms]
            np.testing.assert_allclose(found, [(*c, *h) for c, h in wanted])
            assert all(np.allclose(geom.friction, friction) for geom in geoms)
            assert {int(geom.condim[0]) for geom in geoms} <= {3 if name == "PnPShelf" else 6}


@pytest.mark.parametrize("name", FIGURES)
def test_starts_and_goals_have_the_figures(name: str) -> None:
    reference, start, goal, (low, high, chance), *_ = FIGURES[name]
    marks, rng = fetch_scene(TASKS[name]).landmarks, np.random.default_rng(0)
    draws = [TASKS[name].sample(rng, marks) for _ in range(4000)]
    starts, goals = (np.array(points) for points in zip(*draws, strict=True))
    origin = np.array(getattr(marks, reference)[:2])
    for points, (x0, x1, y0, y1) in ((starts, start), (goals[:, :2], goal)):
        np.testing.assert_allclose((points - origin).min(axis=0), (x0, y0), atol=0.005)
        np.testing.assert_allclose((points - origin).max(axis=0), (x1, y1), atol=0.005)
    nearest = 0.15 if name == "PushDoubleObstacles" else 0.10
    assert np.hypot(*(starts - origin).T).min() == pytest.approx(nearest, abs=0.003)
    if name == "PnPInsertion":
        assert 0.15 <= np.hypot(*(starts - goals[:, :2]).T).min() < 0.155
    above = goals[:, 2] - marks.rest_height
    lifted = above[above > 1e-9]
    assert len(lifted) / len(goals) == pytest.approx(chance, abs=0.03)
    if chance:
        assert (lifted.min(), lifted.max()) == pytest.approx((low, high), abs=0.005)


def test_every_task_has_its_figures_here() -> None:
    from sb3_follow_object.envs.task_table import BUILT_IN, lookup

    assert {lookup(env_id)[0].name for env_id in BUILT_IN} == set(FIGURES)


def test_the_object_alone_turns_by_its_actions() -> None:
    env = ObjectEnv("PnPSimpleV1")
    env.reset(seed=0)
    for _ in range(10):
        obs, *_ = env.step(np.array([0, 0, 0.5, 0, 0, 0, 1.0]))  # off the table, about the vertical
    assert abs(obs["observation"][5]) > 0.3


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: Height(0.3, 0.1), "0 <= low <= high"),
        (lambda: Height(-0.3, 0.1), "0 <= low <= high"),
        (lambda: Height(0.0, float("nan")), "0 <= low <= high"),
        (lambda: Height(0.0, 0.1, 2.0), "chance lies in"),
        (lambda: Region("table", (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)), "x, y. each"),  # type: ignore
    ],
)
def test_figures_that_cannot_be_meant_are_refused(make: Any, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        make()
