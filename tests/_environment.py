"""Virtual environments that see what is installed in the one that runs the tests."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def environment_beside(place: Path, *lines: str) -> Path:
    """Make an environment with the packages of this one, and return its interpreter.

    Where this one is confined to an instruction set (``tests/validation/processors``), so is the new one: its packages
    are those that the confined interpreter alone can load.

    Args:
        place: Where it is made.
        lines: Further lines of the ``.pth`` file, which the interpreter reads when it starts.
    """
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(place)], check=True)
    (library,) = (place / "lib").glob("python*")
    packages = [each for each in sys.path if each.endswith("site-packages")]
    (library / "site-packages/here.pth").write_text("\n".join([str(ROOT), *packages, *lines]))
    python = place / "bin/python"
    if sys.prefix != sys.base_prefix and not Path(sys.executable).is_symlink():
        python.unlink()
        shutil.copy(sys.executable, python)
    return python
