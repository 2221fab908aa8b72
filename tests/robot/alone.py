"""What holds where vlatool-runtime is all that is installed beside numpy and an engine.

Usage: python -W error tests/robot/alone.py BUNDLE

Every module imports, none of the build side's packages is there, and what is absent is named with what installs it.
Prints one line; exits with a traceback when one of these does not hold.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import pkgutil
import subprocess
import sys
from pathlib import Path

import vlatool

ABSENT = {"typer", "pydantic", "rich", "psutil", "pyyaml", "scipy", "onnx", "torch"}


def main(bundle: str) -> None:
    """Look at everything."""
    installed = {each.metadata["Name"].lower() for each in importlib.metadata.distributions()}
    assert not ABSENT & installed, ABSENT & installed
    names = [module.name for module in pkgutil.walk_packages(vlatool.__path__, "vlatool.")]
    for name in names:
        if not name.endswith("__main__"):
            importlib.import_module(name)
    done = told("-m", "vlatool", "benchmark", bundle)
    assert done.returncode == 4, done
    assert "the command line is in vlatool.\n  fix: pip install vlatool on another machine" in done.stderr, done.stderr
    assert "Traceback" not in done.stderr, done.stderr
    done = told("-c", f"import vlatool; vlatool.load({bundle!r}, engine='openvino')")
    assert "fix: pip install 'vlatool-runtime[openvino]'" in done.stderr, done.stderr
    print(f"{len(names)} modules import from {vlatool.__file__}; what is absent is named")


def told(*words: str) -> subprocess.CompletedProcess[str]:
    """Run Python where no folder of vlatool lies."""
    place = Path(sys.executable).parent
    return subprocess.run([sys.executable, *words], capture_output=True, text=True, check=False, cwd=place)


if __name__ == "__main__":
    main(str(Path(sys.argv[1]).resolve()))
