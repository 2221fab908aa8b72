"""Open a graph in a process of its own first: engines crash on some quantized graphs instead of refusing them."""

from __future__ import annotations

import subprocess
from pathlib import Path

from vlatool.errors import GraphError
from vlatool.machine.processes import python_code
from vlatool.runtime.engine import engine_class

CODE = """
import sys
from pathlib import Path
from vlatool.runtime.engine import engine_class
engine_class(sys.argv[1])(Path(sys.argv[2]), 1)
"""


def open_apart(path: Path, engine: str, precision: str, remedy: str) -> None:
    """Let a child open a graph.

    Args:
        path: The graph.
        engine: The engine that shall run it; the default one when empty.
        precision: What layers of it were quantized to.
        remedy: What to do where the engine crashes.

    Raises:
        GraphError: when the child was killed by a signal; a refusal is left to the engine's own message.
    """
    done = subprocess.run(python_code(CODE, [engine, str(path)]), capture_output=True, check=False)
    if done.returncode < 0:
        title = engine_class(engine).title
        raise GraphError(
            f"{title} crashes (signal {-done.returncode}) when it opens {path.name} with these layers in {precision}.",
            remedy,
        )
