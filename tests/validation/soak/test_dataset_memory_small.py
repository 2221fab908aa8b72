"""``dataset_memory.py`` in its small form: it runs, and its limit is one that can be exceeded."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).with_name("dataset_memory.py")


@pytest.mark.parametrize(("limit", "code"), [(400, 0), (10, 1)])
def test_the_peak_is_held_against_the_limit(limit: int, code: int) -> None:
    for package in ("av", "pyarrow"):
        pytest.importorskip(package, reason=f"datasets of LeRobot are read with {package} (extra data)")
    line = [sys.executable, SCRIPT, "--episodes", "4", "--frames", "60", "--limit-mb", str(limit)]
    run = subprocess.run(line, capture_output=True, text=True)
    assert run.returncode == code, run.stderr
    assert run.stdout.splitlines()[1].startswith("128 samples in")
