"""The edge of what an object lies on, and an object that is kept off it."""

import mujoco
import numpy as np
import pytest

from sb3_follow_object.envs import make_vec
from sb3_follow_object.envs.surface import surface_bounds

UNKNOWN = [[-np.inf, -np.inf], [np.inf, np.inf]]
CUBE = '<geom type="box" size="0.02 0.03 0.04"/>'
FREE = "<freejoint/>"


def bounds_of(scene: str, thing: str = CUBE, joint: str = FREE, pos: str = "0.1 0.2 0.14") -> list:
    """The bounds of a thing, 4 cm high above its origin, on a scene whose face is at 0.1."""
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody>{scene}<body name="thing" pos="{pos}">{joint}{thing}</body>'
        "</worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return surface_bounds(model, data, model.body("thing").id).round(6).tolist()


@pytest.mark.parametrize(
    ("scene", "expected"),
    [
        ('<geom type="box" size="0.5 0.4 0.05" pos="0 0 0.05"/>', [[-0.48, -0.38], [0.48, 0.38]]),
        # lying on its side: its height is along y
        (
            '<geom type="box" size="0.5 0.05 0.4" euler="90 0 0" pos="0 0 0.05"/>',
            [[-0.48, -0.38], [0.48, 0.38]],
        ),
        # a mat on it has no edge of its own
        (
            '<geom type="box" size="0.2 0.3 0.002" pos="0.1 0.1 0.1"/>'
            '<geom type="box" size="0.5 0.4 0.05" pos="0 0 0.05"/>',
            [[-0.48, -0.38], [0.48, 0.38]],
        ),
        # a table beside it, as high
        (
            '<geom type="box" size="0.5 0.4 0.05" pos="0 0 0.05"/>'
            '<geom type="box" size="0.5 0.4 0.05" pos="1.1 0 0.05"/>',
            [[-0.48, -0.38], [0.48, 0.38]],
        ),
        # the table, not the floor and not what stands below it
        (
            '<geom type="plane" size="0 0 1"/><geom type="box" size="0.5 0.4 0.05" pos="0 0 0.05"/>'
            '<geom type="box" size="0.2 0.3 0.02" pos="0 0 0.02"/>',
            [[-0.48, -0.38], [0.48, 0.38]],
        ),
    ],
)
def test_a_thing_stays_on_its_surface_by_as_much_as_it_is_narrow(
    scene: str, expected: list
) -> None:
    assert bounds_of(scene) == expected


TABLE = '<geom type="box" size="0.5 0.4 0.05" pos="0 0 0.05"/>'


@pytest.mark.parametrize("turn", [0, 20, 45, 90])
@pytest.mark.parametrize(
    ("thing", "narrow"),
    [
        ('<geom type="box" size="0.15 0.01 0.04" euler="0 0 {}"/>', 0.01),
        ('<geom type="cylinder" size="0.1 0.04" euler="0 0 {}"/>', 0.1),
        # a hammer, whose origin lies where its head is
        (
            '<geom type="box" size="0.03 0.02 0.04" euler="0 0 {0}"/>'
            '<geom type="box" size="0.2 0.005 0.04" euler="0 0 {0}"/>',
            0.02,
        ),
    ],
)
def test_how_a_thing_is_turned_does_not_move_its_bounds(
    thing: str, narrow: float, turn: int
) -> None:
    low, high = np.array(bounds_of(TABLE, thing.format(turn)))
    np.testing.assert_allclose(high, [0.5 - narrow, 0.4 - narrow], atol=2e-6)
    np.testing.assert_allclose(low, -high, atol=2e-6)


def test_of_a_thing_of_many_parts_those_at_its_rim_count() -> None:
    at = np.random.default_rng(0).uniform([-0.1, -0.05], [0.1, 0.05], (300, 2))
    parts = [f'<geom type="box" size="0.01 0.01 0.04" pos="{x} {y} 0"/>' for x, y in at]
    rim = '<geom type="box" size="0.12 0.07 0.04"/>'
    assert bounds_of(TABLE, rim + "".join(parts)) == [[-0.43, -0.33], [0.43, 0.33]]


@pytest.mark.parametrize(
    ("scene", "options"),
    [
        ('<geom type="plane" size="1 1 1" pos="0 0 0.1"/>', {}),  # endless to what touches it
        ('<geom type="box" size="0.5 0.4 0.05" pos="0 0 0.03"/>', {}),  # 2 cm below
        ('<geom type="box" size="0.5 0.4 0.05" pos="0 1 0.05"/>', {}),  # beside it
        ('<geom type="box" size="0.5 0.4 0.05" pos="0 0 0.05" euler="0 0 20"/>', {}),
        ('<geom type="plane" size="1 1 1" pos="0 0 0.1" euler="0 3 0"/>', {}),
        ('<geom type="cylinder" size="0.5 0.05" pos="0 0 0.05"/>', {}),
        ('<geom type="box" size="0.5 0.4 0.05" pos="0 0 0.05" contype="0" conaffinity="0"/>', {}),
        (
            '<body mocap="true"><geom type="box" size="0.5 0.4 0.05" pos="0 0 0.05"/></body>',
            {},
        ),
        ('<geom type="box" size="0.5 0.4 0.05" pos="0 0 0.05"/>', {"joint": "<joint/>"}),
        ('<geom type="box" size="0.5 0.4 0.05" pos="0 0 0.05"/>', {"joint": ""}),
        # wider than what it lies on
        ('<geom type="box" size="0.5 0.015 0.05" pos="0 0.2 0.05"/>', {}),
        # a table of two halves
        (
            '<geom type="box" size="0.25 0.4 0.05" pos="-0.25 0 0.05"/>'
            '<geom type="box" size="0.25 0.4 0.05" pos="0.25 0 0.05"/>',
            {},
        ),
    ],
)
def test_of_other_surfaces_no_edge_is_known(scene: str, options: dict) -> None:
    assert bounds_of(scene, **options) == UNKNOWN


@pytest.mark.parametrize("direction", [(1, 0), (-1, 0), (0, -1)])
def test_an_object_on_the_table_is_pulled_up_to_the_edge_and_no_further(direction) -> None:
    env = make_vec("FollowObject/PushMiddleGapObject-v0", 2, seed=3, on_table=True)
    env.reset()
    actions = np.zeros((2, 7))
    actions[:, :2] = direction
    for _ in range(25):
        obs = env.step(actions)[0]
    off = np.abs(obs["achieved_goal"][:, :2] - [1.3, 0.75])
    axis = int(direction[0] == 0)
    np.testing.assert_allclose(off[:, axis], (0.225, 0.325)[axis], atol=2e-3)
    np.testing.assert_allclose(obs["achieved_goal"][:, 2], 0.4249, atol=2e-3)
    env.close()


def test_an_object_that_may_leave_the_table_flies_over_the_edge() -> None:
    env = make_vec("FollowObject/PushMiddleGapObject-v0", 1, seed=3)
    env.reset()
    for _ in range(25):
        obs = env.step(np.eye(7)[:1])[0]
    assert obs["achieved_goal"][0, 0] > 1.3 + 0.25
    env.close()
