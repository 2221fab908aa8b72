"""A process under limits, for real."""

import os
import subprocess
import sys
import time

import pytest

from vlatool.errors import UsageError
from vlatool.machine.processes import python_code, python_command
from vlatool.measurement import process_limits
from vlatool.measurement.jobs import Limits
from vlatool.measurement.process_limits import choose_processors, command, control_group, ran_out

USES = "import os, sys; print(sorted(os.sched_getaffinity(0)))"


def test_without_limits_the_command_is_plain():
    assert command(Limits(), "json.tool", ["-h"]) == python_command("json.tool", ["-h"])
    assert not Limits()
    assert Limits(cores=1)
    assert Limits(memory_mb=1)


def test_a_module_runs_under_limits(tmp_path, monkeypatch):
    (tmp_path / "told.py").write_text(
        "import os, resource, sys\n"
        "print(sys.argv[1:], sorted(os.sched_getaffinity(0)), resource.getrlimit(resource.RLIMIT_DATA)[0])\n"
    )
    cpu = sorted(os.sched_getaffinity(0))[-1]
    monkeypatch.syspath_prepend(tmp_path)
    words = command(Limits((cpu,), memory_mb=500), "told", ["x", "y"])
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == f"['x', 'y'] [{cpu}] 500000000"


def test_the_first_processors_are_taken_and_missing_ones_named():
    usable = sorted(os.sched_getaffinity(0))
    assert choose_processors(Limits(cores=1)).cpus == (usable[0],)
    assert choose_processors(Limits((usable[-1],), 3)).cpus == (usable[-1],)
    assert choose_processors(Limits(memory_mb=5)) == Limits(memory_mb=5)
    with pytest.raises(UsageError, match=f"names processor 9999; this process may use {usable[0]}"):
        choose_processors(Limits((9999,)))


def test_a_control_group_is_made_where_there_is_one_and_removed(tmp_path, monkeypatch):
    base = tmp_path / "memory"
    base.mkdir()
    monkeypatch.setattr(process_limits, "GROUPS", ((base, "memory.max", ("memory.swap.max", "0")),))
    with control_group(Limits(memory_mb=100)) as limits:
        assert limits.cgroup == "", "a plain directory is no control group"
        assert list(base.iterdir()) == []
    with control_group(Limits(cores=1)) as limits:
        assert limits == Limits(cores=1)


def test_what_needs_more_memory_is_stopped(tmp_path, monkeypatch):
    (tmp_path / "hungry.py").write_text(
        "block = bytearray(400_000_000)\nblock[::4096] = bytes(len(block[::4096]))\nprint('lived')\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    with control_group(Limits(memory_mb=200)) as limits:
        done = subprocess.run(command(limits, "hungry"), capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "lived" not in done.stdout
    assert done.returncode == -9 if limits.cgroup else "MemoryError" in done.stderr
    assert not limits.cgroup or not os.path.exists(limits.cgroup)


def test_a_group_says_whether_it_ended_a_process(tmp_path):
    limits = Limits(memory_mb=5, cgroup=str(tmp_path))
    assert not ran_out(Limits(memory_mb=5))
    assert not ran_out(limits)
    (tmp_path / "memory.oom_control").write_text("oom_kill_disable 0\nunder_oom 0\noom_kill 0\n")
    assert not ran_out(limits)
    (tmp_path / "memory.oom_control").write_text("oom_kill_disable 0\nunder_oom 0\noom_kill 2\n")
    assert ran_out(limits)
    (tmp_path / "memory.events").write_text("low 0\noom 1\noom_kill 0\n")
    assert not ran_out(limits)


def test_groups_of_runs_that_were_killed_are_removed(tmp_path, monkeypatch):
    monkeypatch.setattr(process_limits, "GROUPS", ((tmp_path, "memory.max", ("memory.swap.max", "0")),))
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    for name in (f"vlatool-{gone.pid}-a", f"vlatool-{os.getpid()}-b", "vlatool-x-c", "other"):
        (tmp_path / name).mkdir()
    with control_group(Limits(cores=1)):
        pass
    assert {each.name for each in tmp_path.iterdir()} == {f"vlatool-{os.getpid()}-b", "vlatool-x-c", "other"}


def test_a_process_ends_with_the_one_that_started_it(tmp_path):
    child = "import sys, time; from vlatool.machine.processes import die_with_parent; die_with_parent(); " + (
        "print('up', flush=True); time.sleep(60)"
    )
    parent = (
        f"import subprocess, sys; child = subprocess.Popen({python_code(child)!r}); "
        "print(child.pid, flush=True); child.wait()"
    )
    started = subprocess.Popen(python_code(parent), stdout=subprocess.PIPE, text=True)
    lines = {started.stdout.readline().strip() for _ in range(2)}
    (number,) = lines - {"up"}
    started.kill()
    started.wait()
    started.stdout.close()
    end = time.monotonic() + 10
    while os.path.exists(f"/proc/{number}") and time.monotonic() < end:
        time.sleep(0.02)
    assert not os.path.exists(f"/proc/{number}")
