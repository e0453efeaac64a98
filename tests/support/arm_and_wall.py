"""The environment that docs/own_task.md shows, run as it stands there."""

import re

from tree import ROOT

_TUTORIAL = (ROOT / "docs" / "own_task.md").read_text()
(_CODE,) = (
    block
    for block in re.findall(r"```python\n(.*?)```", _TUTORIAL, re.DOTALL)
    if "class ArmAndWall" in block
)
exec(compile(_CODE, "docs/own_task.md", "exec"), globals())

ARM = "ArmAndWall-v0"
