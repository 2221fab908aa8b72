"""Measures closed-loop success per task on held-out seeds, with the right or a wrong instruction."""

from pathlib import Path

from closed_loop import main

if __name__ == "__main__":
    main(Path(__file__).parent)
