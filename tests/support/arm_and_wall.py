"""The environment that docs/tutorials/own_robot.md shows, run as it stands there."""

import re

from tree import ROOT

_TUTORIAL = (ROOT / "docs" / "tutorials" / "own_robot.md").read_text()
(_CODE,) = (
    block
    for block in re.findall(r"```python\n(.*?)```", _TUTORIAL, re.DOTALL)
    if "class ArmAndWall" in block
)
exec(compile(_CODE, "docs/tutorials/own_robot.md", "exec"), globals())

ARM = "ArmAndWall-v0"
