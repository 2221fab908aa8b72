"""Measures closed-loop success per task on held-out seeds, with the right or a wrong instruction."""

from pathlib import Path

import neighbor  # noqa: F401
from closed_loop import main

if __name__ == "__main__":
    main(Path(__file__).parent)
