"""A call of an environment that never returns is ended from outside and told; no finished episode is lost."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import psutil
import pytest
from _full import small_or_full

from vlatool.bundle.bundle import Bundle
from vlatool.episodes.environment import time_limit, timeout_of
from vlatool.episodes.jobs import disturbances_of, run_jobs
from vlatool.episodes.play import EpisodesJob
from vlatool.errors import DataError, SourceError
from vlatool.evaluate.closed_loop import ClosedLoop
from vlatool.files.resumable_work import Store
from vlatool.machine.watched_calls import Page, new_page, watched_call
from vlatool.module.description import read_description
from vlatool.stage.base import Context

WORLD = """\
import ctypes, os, signal, subprocess, sys, time
import numpy as np

class World:
    def __init__(self, task):
        self.task, self.seed = task, None
        self.may("make()")

    def may(self, call):
        with open(os.path.join(os.path.dirname(__file__), "../calls"), "a") as stream:
            stream.write(f"{os.getpid()} {call} {self.task} {self.seed}\\n")
        if call == "CALL" and self.seed in (17, None) and self.task == "reach":
            HANG

    def observation(self):
        return {"image": np.zeros((8, 8, 3), np.uint8), "proprio": np.zeros(3), "instruction": "go"}

    def reset(self, *, seed=None, options=None):
        self.seed = seed
        self.may("reset()")
        return self.observation(), {}

    def step(self, action):
        self.may("step()")
        return self.observation(), 1.0, True, False, {"success": True}

    def close(self):
        self.may("close()")

def make(task):
    return World(task)
"""
SLEEPS, HOLDS = "time.sleep(1000)", "ctypes.PyDLL(None).sleep(1000)"
"""The second one lets no thread of its process run."""
HANGS = {
    "sleeps": SLEEPS,
    "holds the lock": HOLDS,
    "blocks signals": f"signal.pthread_sigmask(signal.SIG_BLOCK, range(1, 64)); {HOLDS}",
    "prints for ever": "[print('still here', flush=True) for _ in iter(int, 1)]",
    "computes for ever": "[0 for _ in iter(int, 1)]",
    "waits for a child": "subprocess.run(['sleep', '1000'])",
    "catches everything": "exec('while True:\\n try: time.sleep(1000)\\n except BaseException: pass')",
}


def world(folder: Path, call: str = "", hang: str = SLEEPS) -> Path:
    """Write an environment in which a call for task 'reach' at seed 17 never returns."""
    folder.mkdir(exist_ok=True)
    (folder / "world.py").write_text(WORLD.replace("CALL", call or "none").replace("HANG", hang))
    return folder


def job(folder: Path, seeds: tuple[int, ...] = (16, 17), task: str = "reach", timeout_s: float = 1.0) -> EpisodesJob:
    return EpisodesJob("world.py:make", str(folder), task, seeds, timeout_s=timeout_s)


def alive(folder: Path) -> list[int]:
    """Return the processes that played and are still there; those that are being killed have a moment."""
    pids = {int(line.split()[0]) for line in (folder.parent / "calls").read_text().splitlines()}
    _, left = psutil.wait_procs([psutil.Process(pid) for pid in pids if psutil.pid_exists(pid)], timeout=5)
    return [process.pid for process in left]


@pytest.mark.parametrize(("call", "hang", "workers"), small_or_full(
    [("reset()", SLEEPS, 2), ("step()", HOLDS, 1), ("close()", SLEEPS, 1), ("close()", HOLDS, 2)],
    list(product(("reset()", "step()", "close()"), (SLEEPS, HOLDS), (1, 2))),
))  # fmt: skip
def test_a_call_that_never_returns_is_ended(tmp_path: Path, float_bundle: Bundle, call: str, hang: str, workers: int):
    folder, begun = world(tmp_path / "world", call, hang), time.monotonic()
    jobs = [job(folder), job(folder, (18,), "push")]
    with pytest.raises(SourceError) as caught:
        run_jobs(float_bundle, jobs, "", Context(workers=workers))
    when = "after" if call == "close()" else "at"
    said = f"{call} of the environment of task 'reach' did not return within 1 s {when} seed 17."
    assert caught.value.message == said
    for part in ("--environment-timeout 2", "timeout: 2 under environment in policy.yaml", "make(task='reach')"):
        assert part in caught.value.fix
    assert caught.value.exit_code == 3
    assert time.monotonic() - begun < 60
    assert alive(folder) == []


@pytest.mark.parametrize("name", HANGS)
def test_however_it_hangs(tmp_path: Path, float_bundle: Bundle, name: str):
    folder = world(tmp_path / "world", "step()", HANGS[name])
    with pytest.raises(
        SourceError, match=r"step\(\) of the environment of task 'reach' did not return within 0.5 s at"
    ):
        run_jobs(float_bundle, [job(folder, timeout_s=0.5)], "", Context())
    assert alive(folder) == []


def test_making_an_environment_is_limited_too(tmp_path: Path, float_bundle: Bundle):
    folder = world(tmp_path / "world", "make()")
    with pytest.raises(
        SourceError, match=r"^make\(\) of the environment of task 'reach' did not return within 0.5 s\."
    ):
        run_jobs(float_bundle, [job(folder, timeout_s=0.5)], "", Context())
    with pytest.raises(SourceError, match=r"make\(\) .* did not return within 0.5 s"):
        disturbances_of(float_bundle, job(folder, timeout_s=0.5), Context())


def test_what_is_waited_for_is_said(tmp_path: Path, float_bundle: Bundle):
    told: list[str] = []
    folder = world(tmp_path / "world", "reset()", "time.sleep(2.5)")
    outcomes = run_jobs(
        float_bundle, [job(folder, timeout_s=10.0)], "", Context(lambda what, _share: told.append(what))
    )
    assert len(outcomes) == 2
    waiting = [what for what in told if what.startswith("waiting")]
    assert waiting[:2] == [
        "waiting for reset() of task 'reach' at seed 17, 1 s of 10 s",
        "waiting for reset() of task 'reach' at seed 17, 2 s of 10 s",
    ]
    assert not [what for what in told if what.startswith("ended")]


def test_an_ordinary_world_is_played_within_its_limit(tmp_path: Path, float_bundle: Bundle):
    folder = world(tmp_path / "world", "step()", "time.sleep(0.3)")
    assert len(run_jobs(float_bundle, [job(folder, (16, 17, 18), timeout_s=20.0)], "", Context())) == 3


def test_the_limit_of_all_commands(tmp_path: Path, float_bundle: Bundle, monkeypatch):
    monkeypatch.setenv("VLATOOL_LIMITS", "environment_seconds=1")
    with pytest.raises(SourceError, match="did not return within 1 s") as caught:
        run_jobs(float_bundle, [job(world(tmp_path / "world", "reset()"), timeout_s=0.0)], "", Context())
    assert "VLATOOL_LIMITS=environment_seconds=2" in caught.value.fix


@pytest.mark.parametrize("workers", [1, 2])
def test_finished_episodes_are_taken_when_it_goes_on(tmp_path: Path, float_bundle: Bundle, workers: int):
    folder = world(tmp_path / "world", "step()", f"os.path.exists({str(tmp_path / 'mended')!r}) or {SLEEPS}")
    jobs = [job(folder, (14, 15, 16, 17, 18)), job(folder, (16, 17), "push")]
    with Store.open(tmp_path / "store") as kept, pytest.raises(SourceError, match="at seed 17"):
        run_jobs(float_bundle, jobs, "", Context(workers=workers), store=kept)
    (tmp_path / "mended").touch()
    (folder.parent / "calls").unlink()
    again = [replace(each, timeout_s=30.0) for each in jobs]
    with Store.open(tmp_path / "store") as kept:
        outcomes = run_jobs(float_bundle, again, "", Context(workers=workers), store=kept)
    seeds = [(outcome.task, outcome.seed) for outcome in outcomes]
    assert seeds == [*(("reach", seed) for seed in range(14, 19)), ("push", 16), ("push", 17)]
    played = [line.split()[2:] for line in (folder.parent / "calls").read_text().splitlines() if "reset()" in line]
    assert ["reach", "14"] not in played
    assert ["reach", "16"] not in played
    assert ["reach", "17"] in played
    assert kept.taken >= 3


def test_the_command_line_plays_on(tmp_path: Path, float_bundle: Bundle, monkeypatch):
    """The limit is no part of what decides an outcome: with a longer one, what is finished counts."""
    monkeypatch.setenv("VLATOOL_CACHE", str(tmp_path / "cache"))
    folder = world(tmp_path / "world", "step()", f"os.path.exists({str(tmp_path / 'mended')!r}) or {SLEEPS}")
    stage = ClosedLoop(environment=f"{folder}/world.py:make", tasks=("reach",), episodes=3, first_seed=15)
    short = stage.model_copy(update={"environment_timeout": 1.0})
    assert short.key("x") == stage.key("x")
    with pytest.raises(SourceError, match="did not return within 1 s at seed 17"):
        short.run(float_bundle, Context(work=str(tmp_path / "cache/streams/work")))
    (tmp_path / "mended").touch()
    report = stage.run(float_bundle, Context(work=str(tmp_path / "cache/streams/work")))
    assert any(note.startswith("2 of the 3 episodes are of an interrupted run") for note in report.warnings)


def test_the_declaration_names_the_limit(policy_dir: Path):
    text = (policy_dir / "policy.yaml").read_text()
    (policy_dir / "policy.yaml").write_text(text.replace("tasks: [reach, push]", "tasks: [reach, push]\n  timeout: 7"))
    described = read_description(policy_dir)
    assert timeout_of(described.environment) == 7
    jobs = ClosedLoop(policy=policy_dir, episodes=2)._jobs(None)
    assert {each.timeout_s for each in jobs} == {7}
    asked = ClosedLoop(policy=policy_dir, episodes=2, environment_timeout=9)._jobs(None)
    assert {each.timeout_s for each in asked} == {9}


@pytest.mark.parametrize("value", ["soon", "0", "-1", "true", ".nan", "[1]"])
def test_a_limit_that_is_none(policy_dir: Path, value: str):
    text = (policy_dir / "policy.yaml").read_text()
    (policy_dir / "policy.yaml").write_text(text.replace("tasks: [reach, push]", f"tasks: [reach]\n  timeout: {value}"))
    with pytest.raises(SourceError, match="'timeout' under environment is "):
        read_description(policy_dir)


@pytest.mark.parametrize("value", ["soon", -1, True, float("nan"), [1]])
def test_a_limit_of_a_manifest_that_is_none(value: Any):
    with pytest.raises(DataError, match="'timeout' of the environment is "):
        timeout_of({"timeout": value})


def noted(write: Callable[[Page], None]) -> Any:
    fd = new_page()
    page = Page(fd)
    write(page)
    try:
        return Page(fd).read()
    finally:
        os.close(fd)


def test_a_page_is_read_by_another_process_and_nothing_else_is_believed():
    call = noted(lambda page: page.begin("reset()", "reset() of it", "at seed 1", "raise it", 2.0))
    assert (call.waiting, call.whose, call.at, call.fix, call.limit_s) == (
        "reset()",
        "reset() of it",
        "at seed 1",
        "raise it",
        2,
    )
    assert noted(lambda page: None) is None
    assert noted(lambda page: (page.begin("a", "b", "c", "d", 2.0), page.end())) is None
    cut = noted(lambda page: page.begin("\u00e9" * 9999, "b", "c", "d", 2.0))
    assert cut is not None, "words that are too long are cut short: the limit must hold"
    assert cut.waiting in "\u00e9" * 999
    assert (cut.whose, cut.limit_s) == ("b", 2.0)
    assert noted(lambda page: page._memory.__setitem__(slice(0, 99), b"\xff" * 99)) is None
    assert noted(lambda page: page._memory.__setitem__(slice(0, 99), b"\x01" * 99)) is None


def test_a_process_that_nobody_looks_at_calls_as_ever():
    with time_limit("reset()", "reach", 1, 0.01), watched_call("a", "b", "c", "d", 0.01):
        time.sleep(0.02)
