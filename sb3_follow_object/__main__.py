"""`python -m sb3_follow_object` is the command `sb3-follow-object`."""

import sys

from .command.cli import main

sys.exit(main())
