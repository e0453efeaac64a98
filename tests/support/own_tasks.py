"""What a user's module with a task of one's own looks like; tests put it on PYTHONPATH."""

from sb3_follow_object.envs import Box, Region, Task, register_task

register_task(
    Task(
        "PushPast",
        start=Region("gripper", (-0.15, -0.15), (0.15, 0.0)),
        goal=Region("gripper", (-0.10, 0.15), (0.10, 0.25)),
        horizon=40,
        obstacles=(Box((0.0, 0.05, 0.25), (0.06, 0.0125, 0.05)),),
        blocked_gripper=True,
    )
)
