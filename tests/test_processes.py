from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from vlatool.processes import SINGLE, environment, single_threads


def test_processes_that_are_started_meanwhile_compute_in_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "5")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    with single_threads():
        assert {os.environ[name] for name in SINGLE} == {"1"}
    assert os.environ["OMP_NUM_THREADS"] == "5"
    assert "MKL_NUM_THREADS" not in os.environ


def test_a_process_finds_this_vlatool_from_anywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", "/somewhere/else")
    found = environment()
    assert found["PYTHONPATH"].endswith(f"{os.pathsep}/somewhere/else")
    assert os.environ["PYTHONPATH"] == "/somewhere/else"
    line = [sys.executable, "-S", "-c", "import vlatool; print(vlatool.__file__)"]  # -S: nothing that is installed
    told = subprocess.run(line, env=found, cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    assert Path(told.strip()).parent.name == "vlatool"
