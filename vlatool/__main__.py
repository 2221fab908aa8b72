"""``vlatool`` and ``python -m vlatool``."""

import contextlib
import os
import signal
import sys

INTERRUPT_CODE = 130
"""Exit code after Ctrl-C, as ``vlatool.cli`` has it."""


def _interrupted(*_: object) -> None:
    """End at once: while modules are imported nothing is to be tidied up, and an exception may be taken for another."""
    with contextlib.suppress(OSError):
        os.write(sys.__stderr__.fileno() if sys.__stderr__ else 2, b"interrupted\n")
    os._exit(INTERRUPT_CODE)


if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    with contextlib.suppress(ValueError):  # of a thread that may not
        signal.signal(signal.SIGINT, _interrupted)  # ``vlatool.cli.main`` takes it back

with contextlib.suppress(OSError):  # of a current directory that is gone
    if __name__ == "__main__" and sys.path[:1] in ([""], [os.getcwd()]):
        del sys.path[0]  # "python -m" puts the current directory there: a *.dist-info in it would be a plug-in

from vlatool.errors import DISTRIBUTION, MissingExtra  # noqa: E402 (Ctrl-C is taken care of first)


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

if __name__ == "__main__":
    main()
