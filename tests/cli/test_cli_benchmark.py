"""`vlatool benchmark` as it is typed, and as it is ended."""

import json
import os
import signal
import subprocess
import sys
import time

import psutil
import pytest
from _full import small_or_full
from _processes import below

from vlatool.measurement.agent import WORKER
from vlatool.report import Report

QUICK = ["--iterations", 20, "--duration", 0, "--no-cold", "--no-phase"]


def command(*words):
    return [sys.executable, "-m", "vlatool", "benchmark", *map(str, words)]


def gone(processes, seconds=10):
    return not psutil.wait_procs(processes, timeout=seconds)[1]


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGKILL, -9), (signal.SIGINT, 130), *small_or_full([], [(signal.SIGTERM, 143)])]
)
def test_nothing_is_left_when_a_run_is_ended(float_bundle, number, code):
    with subprocess.Popen(command(float_bundle.path, "--duration", 60), stderr=subprocess.PIPE) as run:
        end = time.monotonic() + 60
        while b"measuring" not in (line := run.stderr.readline()):
            assert line
            assert time.monotonic() < end
        left = below(run.pid, WORKER)
        assert left
        run.send_signal(number)
        assert run.wait(20) == code
    assert gone(left)


def test_a_reader_of_progress_that_leaves_stops_nothing(float_bundle):
    with subprocess.Popen(
        command(float_bundle.path, *QUICK), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as run:
        run.stderr.close()
        told, code = run.stdout.read(), run.wait(60)
    assert code == 0
    assert "median latency" in told


def test_what_was_measured_is_printed_also_when_it_cannot_be_written(vlatool, float_bundle, tmp_path, monkeypatch):
    from vlatool.cli import _console

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(_console, "write_directory", full)
    code, out, error = vlatool("benchmark", float_bundle.path, *QUICK, "-o", tmp_path / "report")
    assert code == 3
    assert "median latency" in out
    assert "No space left" in error


@pytest.mark.parametrize("below", ["file/report", "file/deep/er"])
def test_a_place_that_cannot_be_written_is_refused_before_the_measurement(vlatool, float_bundle, tmp_path, below):
    (tmp_path / "file").write_text("")
    code, out, error = vlatool("benchmark", float_bundle.path, *QUICK, "-o", tmp_path / below)
    assert (code, out) == (3, "")
    assert "a part of the path is a file" in error


def test_json_is_all_that_is_on_stdout(vlatool, float_bundle):
    code, out, _ = vlatool("benchmark", float_bundle.path, *QUICK, "--rate", 100, "--json")
    report = Report.from_json(out)
    assert (code, report.limits) == (0, {"hz": 100.0})
    assert json.loads(out)["validity"] in ("valid", "suspect")


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (["--target", ""], "is not a machine that ssh can reach"),
        (["--target", "-oProxyCommand=x"], "is not a machine that ssh can reach"),
        (["--remote-python", "python3"], "--remote-python is the Python of a target"),
        (["--rate", 1000, "--duration", 86400], "86,400,000 ticks"),
        (["--emulate"], "--emulate needs a board"),
        (["--pin", 9999], "names processor 9999"),
    ],
)
def test_what_makes_no_sense_is_refused(vlatool, float_bundle, more, told):
    code, out, error = vlatool("benchmark", float_bundle.path, *QUICK, *more)
    assert (code, out) == (2, "")
    assert told in error


def test_a_policy_that_does_not_fit_fails(vlatool, float_bundle):
    code, _, error = vlatool("benchmark", float_bundle.path, *QUICK, "--memory-mb", 20)
    assert code == 1
    assert "does not fit" in error
    assert not [name for name in os.listdir("/sys/fs/cgroup") if name.startswith(f"vlatool-{os.getpid()}")]


def test_other_methods_take_no_target(vlatool, float_bundle):
    code, _, error = vlatool("evaluate", "recorded", float_bundle.path, "--target", "x")
    assert code == 2
    assert "--target" in error
