"""``python -m vlatool``."""

import contextlib
import os
import sys

with contextlib.suppress(OSError):  # of a current directory that is gone
    if sys.path[:1] in ([""], [os.getcwd()]):
        del sys.path[0]  # "python -m" puts the current directory there: a *.dist-info in it would be a plug-in

from vlatool.errors import DISTRIBUTION, MissingExtra


def without_command_line(module: str) -> MissingExtra:
    """Say what the command line lacks where it cannot be imported: ``module``."""
    if DISTRIBUTION != "vlatool":
        why = f"{DISTRIBUTION} loads and runs bundles; the command line is in vlatool."
        fix = "pip install vlatool on another machine; its vlatool benchmark --target measures on this one through ssh"
        return MissingExtra(why, fix)
    return MissingExtra(f"The command line needs the package '{module}'.", "pip install vlatool, without --no-deps")


try:
    from vlatool.cli import main
except ModuleNotFoundError as error:
    if DISTRIBUTION == "vlatool" and str(error.name).startswith("vlatool."):
        raise
    refused = without_command_line(str(error.name))
    sys.stderr.write(f"{refused}\n")
    sys.exit(refused.exit_code)
main()
