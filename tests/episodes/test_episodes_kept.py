"""A run of episodes that is interrupted goes on where it was, and believes nothing that is not what it was."""

from __future__ import annotations

import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from _full import small_or_full

from tests._reach import GOOD, TREMBLES, bundle_of
from vlatool.accuracy.success_comparison import Outcome
from vlatool.bundle.bundle import Bundle
from vlatool.episodes.jobs import outcomes_of
from vlatool.episodes.play import STEP_LIMIT, EpisodesJob, Played
from vlatool.errors import DataError
from vlatool.evaluate.closed_loop import EVALUATION_SEEDS, ClosedLoop
from vlatool.files.messages import to_json
from vlatool.files.resumable_work import Store, remove_all_unused
from vlatool.files.user_files import add_stamp, is_own_file
from vlatool.report import Report
from vlatool.stage.base import Context
from vlatool.stage.cache import contents, prune
from vlatool.stage.run import cached_measure, work_folder

NOTED = """
    def reset(self, *, seed=None):
        with open(__import__("os").environ["PLAYED"], "a") as stream:
            stream.write(f"{seed} ")
"""
COUNT = 40
"""Episodes of an evaluation, in two tasks: four jobs."""


@pytest.fixture(scope="module")
def bundles(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Bundle]:
    folder = tmp_path_factory.mktemp("kept")
    return {name: bundle_of(folder / name, kind) for name, kind in {"good": GOOD, "trembles": TREMBLES}.items()}


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("VLATOOL_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def world(bundles: dict[str, Bundle], tmp_path: Path) -> Path:
    """The folder of an environment that notes each seed in a file elsewhere, see ``played``."""
    code = (bundles["good"].path.parent / "policy/environment.py").read_text()
    folder = tmp_path / "world"
    folder.mkdir()
    noted = code.replace("\n    def reset(self, *, seed=None):\n", NOTED)
    (folder / "environment.py").write_text(noted.replace("self.steps >= 40", "self.steps >= 8"))
    return folder


@pytest.fixture(autouse=True)
def played(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], int]:
    """A function that says how many episodes were begun by processes that were started since it was asked before."""
    places = [tmp_path / "played-0"]
    monkeypatch.setenv("PLAYED", str(places[-1]))

    def more() -> int:
        count = len(places[-1].read_text().split()) if places[-1].exists() else 0
        places.append(tmp_path / f"played-{len(places)}")
        monkeypatch.setenv("PLAYED", str(places[-1]))
        return count

    return more


def taken_of(report: Report) -> tuple[int, int]:
    """Return how many episodes a report says are of an interrupted run, and of how many."""
    (noted,) = [warning for warning in report.warnings if "interrupted run of the same command" in warning]
    taken, asked = (int(word) for word in noted.split() if word.isdigit())
    return taken, asked


def evaluation(world: Path, **options: object) -> ClosedLoop:
    asked = {"environment": f"{world}/environment.py:make", "tasks": ("near", "far"), "episodes": COUNT, **options}
    return ClosedLoop(**asked)


def interrupted_after(stage: ClosedLoop, bundle: Bundle, jobs: int) -> None:
    """Run an evaluation until so many jobs are done."""
    done: list[str] = []

    def tell(what: str, _share: float | None) -> None:
        done.extend([what] * (" succeed (" in what))
        if len(done) == jobs:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stage.run(bundle, Context(tell, work=str(work_folder(stage, bundle))))


def run(stage: ClosedLoop, bundle: Bundle, told: list[str] | None = None) -> Report:
    said = [] if told is None else told
    return stage.run(bundle, Context(lambda what, _: said.append(what), work=str(work_folder(stage, bundle))))


def test_it_goes_on_where_it_was_to_the_same_rows(bundles, world, cache, played):
    stage = evaluation(world)
    whole = stage.run(bundles["good"], Context())
    assert played() == COUNT
    interrupted_after(stage, bundles["good"], 2)
    played()
    told: list[str] = []
    again = run(stage, bundles["good"], told)
    assert again.rows == whole.rows
    taken, asked = taken_of(again)
    assert (taken >= 20, asked) == (True, COUNT)
    assert played() == COUNT - taken, "what was finished is not played again"
    assert again.warnings[:-1] == whole.warnings
    assert f"{taken} episodes are of an interrupted run" in told


def test_a_bundle_beside_one_with_the_same_content_plays_for_itself(bundles, world, cache, played, tmp_path):
    """Episodes that decide by chance would look repeatable, and nothing was interrupted."""
    twin = shutil.copytree(bundles["good"].path, tmp_path / "twin")
    stage = evaluation(world, baseline=twin)
    report = run(stage, bundles["good"])
    assert not any("interrupted" in warning for warning in report.warnings)
    controls = 2 * 20
    again = 2
    assert played() == 2 * COUNT + controls + again
    interrupted_after(stage, bundles["good"], 6)
    played()
    report = run(stage, bundles["good"])
    assert taken_of(report)[0] >= COUNT + 10, "of both"


def test_episodes_that_their_seed_does_not_decide_are_noticed(bundles, world, cache):
    code = (world / "environment.py").read_text()
    (world / "environment.py").write_text(code.replace("np.random.default_rng(seed)", "np.random.default_rng()"))
    for kind in ("trembles", "good"):
        report = evaluation(world, baseline=bundles["good"].path, episodes=8).run(bundles[kind], Context())
        (noticed,) = [line for line in report.warnings if "other episodes for the same seed" in line]
        assert "played again with" in noticed
    (world / "environment.py").write_text(code)
    report = evaluation(world, baseline=bundles["good"].path, episodes=8).run(bundles["trembles"], Context())
    assert not any("for the same seed" in line for line in report.warnings)


def test_an_environment_may_leave_the_directory(bundles, world, cache, monkeypatch):
    code = (world / "environment.py").read_text()
    changed = code.replace("self.steps += 1", 'self.steps += 1; __import__("os").chdir("/")')
    (world / "environment.py").write_text(changed)
    monkeypatch.chdir(world.parent)
    stage = ClosedLoop(environment=f"{world.name}/environment.py:make", tasks=("near", "far"), episodes=8)
    rows = [stage.run(bundles["good"], Context(workers=workers)).rows for workers in (1, 2)]
    assert rows[0] == rows[1]


def test_a_comparison_goes_on_with_its_controls_and_disturbances(bundles, world, cache, played):
    stage = evaluation(
        world, baseline=bundles["good"].path, episodes=COUNT // 2, disturb=("delay",), latency_in_the_loop=True
    )
    interrupted_after(stage, bundles["trembles"], 7)
    played()
    report = run(stage, bundles["trembles"])
    taken, asked = taken_of(report)
    assert taken > COUNT, "of both bundles and of the controls"
    assert played() == asked - taken


def test_without_a_place_to_forget_nothing_is_kept(bundles, world, cache, played):
    evaluation(world).run(bundles["good"], Context())
    assert not cache.exists()


@pytest.mark.parametrize("what", ["code", "data", "other bundle", "another option"])
def test_nothing_is_taken_where_something_else_decides(bundles, world, cache, played, what):
    (world / "levels.bin").write_bytes(b"1")
    stage, bundle = evaluation(world), bundles["good"]
    interrupted_after(stage, bundle, 3)
    played()
    if what == "code":
        (world / "environment.py").write_text((world / "environment.py").read_text() + "\n# another\n")
    elif what == "data":
        (world / "levels.bin").write_bytes(b"22")
    elif what == "other bundle":
        bundle = bundles["trembles"]
    else:
        stage = evaluation(world, first_seed=7)
    report = run(stage, bundle)
    assert played() == COUNT
    assert not any("interrupted" in warning for warning in report.warnings)


@pytest.mark.parametrize("damage", small_or_full(["edited", "another's"], ["half", "emptied", "edited", "another's"]))
def test_what_is_damaged_is_played_again(bundles, world, cache, played, damage):
    stage = evaluation(world)
    whole = stage.run(bundles["good"], Context())
    interrupted_after(stage, bundles["good"], 4)
    first, second, *_ = sorted(cache.glob("streams/*/answer-*.json"))
    content = first.read_bytes()
    turned = (b"true", b"false") if b"true" in content else (b"false", b"true")  # whichever episode sorts first
    new = {"half": content[: len(content) // 2], "emptied": b"", "edited": content.replace(*turned),
           "another's": second.read_bytes()}[damage]  # fmt: skip
    assert new != content
    first.write_bytes(new)
    played()
    again = run(stage, bundles["good"])
    assert again.rows == whole.rows
    assert played() == 10


def test_what_no_episode_is_like_is_played_again_though_its_hash_is_right(bundles, world, cache, played):
    stage = evaluation(world)
    whole = stage.run(bundles["good"], Context())
    interrupted_after(stage, bundles["good"], 4)
    for file, steps in zip(sorted(cache.glob("streams/*/answer-*.json")), (-5, 10**30), strict=False):
        kept = json.loads(file.read_text().partition("\n")[0])
        kept["value"]["outcomes"][3]["steps"] = steps
        file.write_text(add_stamp(json.dumps(kept) + "\n"))
        assert is_own_file(file)
    played()
    assert run(stage, bundles["good"]).rows == whole.rows
    assert played() == 20


LIKE = Outcome("near", 4, True, 1, "go", {"jerk": 0.5}, {"time": "why"}, {"fresh": (1.0,)})


@pytest.mark.parametrize(("field", "value"), [
    ("steps", -5), ("steps", 0), ("steps", 10**30), ("steps", STEP_LIMIT + 1), ("steps", True), ("steps", 3.0),
    ("success", 2), ("success", "yes"), ("seed", 8), ("task", "other"), ("instruction", "x" * 201),
    ("motion", {"jerk": math.nan}), ("motion", {"jerk": math.inf}), ("series", {"fresh": [0.0]}),
])  # fmt: skip
def test_what_no_episode_is_like_is_refused_whoever_says_it(field: str, value: object):
    job = EpisodesJob("world.py:make", "", "near", (4,), show=field != "series")
    answer = to_json(Played((LIKE,)))
    if field != "series":
        assert outcomes_of(answer, job) == (LIKE,)
    answer["outcomes"][0][field] = value
    with pytest.raises(DataError, match="The process that played 'near'"):
        outcomes_of(answer, job)


def test_a_place_that_cannot_be_written_costs_nothing_but_a_sentence(bundles, world, cache):
    cache.mkdir()
    (cache / "streams").write_text("a file")
    told: list[str] = []
    report = run(evaluation(world), bundles["good"], told)
    assert report.rows == evaluation(world).run(bundles["good"], Context()).rows
    (noted,) = [warning for warning in report.warnings if "cannot be stored" in warning]
    assert "VLATOOL_CACHE" in noted
    assert noted in told


def test_who_writes_the_result_removes_what_was_kept(bundles, world, cache):
    report = cached_measure(evaluation(world), bundles["good"], cache, Context())
    assert list((cache / "streams").iterdir()) == []
    interrupted_after(evaluation(world), bundles["good"], 2)
    (entry,) = [entry for entry in contents(cache).entries if entry.what == "unfinished work"]
    assert contents(cache).unknown == ()
    os.utime(cache / entry.name / "lock", (0, 0))
    assert entry.name in {removed.name for removed in prune(cache, older_than_s=3600).entries}
    assert cached_measure(evaluation(world), bundles["good"], cache, Context()) == report


def test_what_another_run_uses_stays(tmp_path):
    with Store.open(tmp_path / "work") as one:
        one.put("a", [1.5, "x"])
        remove_all_unused([tmp_path / "work"])
        assert one.get("a") == [1.5, "x"]
        with Store.open(tmp_path / "work") as other:
            assert other.get("a") == [1.5, "x"]
            assert other.get("b") is None
    remove_all_unused([tmp_path / "work"])
    assert not (tmp_path / "work").exists()


def test_a_command_that_is_killed_goes_on_to_the_same_rows(bundles, world, cache, played):
    code = (world / "environment.py").read_text()
    paused = f'if os.environ.get("PAUSED") and seed == {EVALUATION_SEEDS + 15}: __import__("time").sleep(600)'
    pause = f"import os\n{code}".replace("        random = np", f"        {paused}\n        random = np")
    (world / "environment.py").write_text(pause)
    whole = evaluation(world).run(bundles["good"], Context())
    assert played() == COUNT
    words = ["evaluate", "closed-loop", str(bundles["good"].path), "--environment", f"{world}/environment.py:make",
             "--tasks", "near", "--tasks", "far", "--episodes", str(COUNT), "--workers", "1", "--json",
             "--raw"]  # fmt: skip
    command = [sys.executable, "-m", "vlatool", *words]
    killed = subprocess.Popen(
        command, env={**os.environ, "PAUSED": "1"}, start_new_session=True, stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )  # fmt: skip
    while not (kept := list(cache.glob("streams/*/answer-*.json"))) and killed.poll() is None:
        time.sleep(0.005)
    os.killpg(killed.pid, signal.SIGKILL)
    killed.communicate()
    assert 0 < len(kept) < COUNT / 2
    # another process, not this one: tests that ran here may have added to the packages that can be imported
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    again = Report.from_json(done.stdout)
    assert again.rows == whole.rows, done.stderr
    assert "interrupted run" in str(again.warnings)
    assert list((cache / "streams").iterdir()) == []
