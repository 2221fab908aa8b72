"""Open a graph in a child process first: engines crash on some quantized graphs instead of refusing them."""

from __future__ import annotations

import subprocess
from pathlib import Path

from vlatool.errors import GraphError
from vlatool.machine.processes import python_code
from vlatool.runtime.engine import engine_class

CHILD_CODE = """
import sys
from pathlib import Path
from vlatool.runtime.engine import engine_class
engine_class(sys.argv[1])(Path(sys.argv[2]), 1)
"""


def open_in_child(path: Path, engine: str, precision: str, remedy: str) -> None:
    """Open a graph in a child process; refuse it when that crashes, and leave other refusals to the engine itself.

    Args:
        precision: Precision of its quantized layers.
        remedy: Fix for the case that the engine crashes.
    """
    done = subprocess.run(python_code(CHILD_CODE, [engine, str(path)]), capture_output=True, check=False)
    if done.returncode < 0:
        title = engine_class(engine).title
        raise GraphError(
            f"{title} crashes (signal {-done.returncode}) when it opens {path.name} with these layers in {precision}.",
            remedy,
        )
