"""``python -m vlatool.cli``."""

import contextlib
import os
import sys

from vlatool.cli import main

with contextlib.suppress(OSError):
    if sys.path[:1] in ([""], [os.getcwd()]):
        del sys.path[0]  # see vlatool/__main__.py
main()
