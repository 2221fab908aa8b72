"""Episodes of the tiny world: success depends on the seed alone, so every number is known beforehand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vlatool.accuracy.success_comparison import Outcome, compare_success, success_row
from vlatool.data import observations_for
from vlatool.episodes import play
from vlatool.episodes.jobs import run_jobs
from vlatool.episodes.play import EpisodesJob
from vlatool.errors import DataError, GraphError, MissingExtra, SourceError, UsageError
from vlatool.evaluate.closed_loop import ClosedLoop
from vlatool.report import Row
from vlatool.stage.base import Context

WORLD = """\
import numpy as np

OPEN = []

class World:
    def __init__(self, task):
        OPEN.append(task)
        assert len(OPEN) == 1, f"{len(OPEN)} environments are open at once"

    def reset(self, *, seed=None):
        return {"image": np.zeros((8, 8, 3), np.uint8), "proprio": np.zeros(3), "instruction": "go"}, {}

    def step(self, action):
        return self.reset()[0], 0.0, False, False, {}

    def close(self):
        OPEN.pop()

def make(task):
    return World(task)
"""
FOREVER = "return self.reset()[0], 0.0, False, False, {}"


@pytest.fixture
def world(tmp_path):
    """A function that writes a world whose step is another, and returns ``path:make``."""

    def write(step: str = FOREVER) -> str:
        (tmp_path / "world.py").write_text(WORLD.replace(FOREVER, step))
        return f"{tmp_path / 'world.py'}:make"

    return write


def evaluated(bundle, policy, workers=1, **options):
    stage = ClosedLoop(policy=policy, **{"episodes": 20, "first_seed": 0, **options})
    stage.check(bundle, None)
    return stage.run(bundle, Context(workers=workers))


@pytest.fixture(scope="module")
def paired(float_bundle, int8_bundle, policy_template):
    """One run with a baseline."""
    return evaluated(int8_bundle, policy_template, baseline=float_bundle.path)


def test_success_is_counted_over_the_seeds_with_its_interval(int8_bundle, policy_template):
    (row,) = evaluated(int8_bundle, policy_template).rows
    rate = row.get("success")
    assert (rate.value, rate.samples) == (0.8, 20)
    assert rate.low < 0.8 < rate.high
    assert row.raw["seed"] == [float(seed) for seed in range(10)] * 2
    assert row.raw["success"] == [float(seed % 5 != 0) for seed in range(10)] * 2
    assert row.raw["steps"] == [5.0] * 20
    table = row.details["success by task"]
    assert [(line["task"], line["success"], line["episodes"], line["mean steps"]) for line in table] == [
        ("reach", 0.8, 10, 5.0),
        ("push", 0.8, 10, 5.0),
    ]


def test_a_baseline_plays_the_same_seeds_and_is_paired(paired):
    base, row = paired.rows
    assert (base.name.endswith("/bundle"), base.role, row.role) == (True, "baseline", "subject")
    assert base.raw["seed"] == row.raw["seed"]
    assert row.value("success_drop") == 0.0
    assert row.get("success_drop").low < 0 < row.get("success_drop").high
    assert row.value("mcnemar_p") == 1.0
    assert row.details["paired with the baseline"][0]["episodes"] == 20
    assert base.get("success_drop") is None
    assert paired.kind == "evaluate"
    assert "80.0% of 20 episodes succeed" in paired.summary[0]


def test_the_baseline_must_succeed_more_often_than_who_does_not_look(paired, float_bundle, world):
    chance = paired.rows[0].get("success_chance")
    assert (chance.samples, chance.value < 0.4) == (20, True)
    assert "the better of random and constant" in chance.note
    assert paired.verdict == "info"
    ends = "return self.reset()[0], 0.0, True, False, {'is_success': True}"
    easy = ClosedLoop(environment=world(ends), tasks=("reach",), episodes=4, baseline=float_bundle.path)
    report = easy.run(float_bundle, Context())
    assert report.verdict == "inconclusive"
    assert "100.0% of 4 closed-loop episodes, and actions that do not look" in report.summary[0]


@pytest.mark.parametrize("control", ["random", "constant"])
def test_a_control_acts_without_looking(int8_bundle, policy_template, control):
    one, two = (evaluated(int8_bundle, policy_template, control=control) for _ in range(2))
    assert one.rows == two.rows
    assert one.rows[0].value("success") < 0.4
    assert f"with {control} actions in the place of the policy's" in one.summary[0]


def test_an_environment_that_never_tells_success_is_an_error(int8_bundle, world):
    ends = "return self.reset()[0], 0.0, True, False, {'reached': True}"
    stage = ClosedLoop(environment=world(ends), tasks=("reach",), episodes=2, first_seed=3)
    with pytest.raises(DataError, match="never told whether the episode of seed 3 succeeded"):
        stage.run(int8_bundle, Context())


def naming(bundle, **environment):
    return replace(bundle, manifest=replace(bundle.manifest, environment=environment))


def test_the_baseline_says_what_is_played(float_bundle, policy_template, monkeypatch, tmp_path):
    """A variant that lists the easy task alone, or another environment, is not judged by its own choice."""
    monkeypatch.chdir(policy_template)
    make = "environment.py:make"
    for environment, says in (
        ({"make": make, "tasks": ["reach"]}, r"tasks \['reach'\], the baseline \['reach', 'push'\]"),
        ({"make": "easy.py:make", "tasks": ["reach", "push"]}, f"make 'easy.py:make', the baseline '{make}'"),
    ):
        stage = ClosedLoop(baseline=float_bundle.path, episodes=4)
        with pytest.raises(DataError, match=f"names another environment than its baseline: {says}"):
            stage._jobs(naming(float_bundle, **environment))
        named = ClosedLoop(policy=policy_template, baseline=float_bundle.path, episodes=4)
        assert [job.task for job in named._jobs(naming(float_bundle, **environment))] == ["reach", "push"]
    jobs = ClosedLoop(baseline=float_bundle.path, episodes=4)._jobs(naming(float_bundle))
    assert [(job.environment, job.task) for job in jobs] == [(make, "reach"), (make, "push")]


def test_two_workers_give_what_one_gives(paired, float_bundle, int8_bundle, policy_template):
    again = evaluated(int8_bundle, policy_template, workers=2, baseline=float_bundle.path)
    assert again.rows == paired.rows
    assert again.summary == paired.summary


def test_the_wrong_instruction_is_a_control_and_the_title_says_so(int8_bundle, policy_template):
    report = evaluated(int8_bundle, policy_template, instruction="wrong", tasks=("reach",))
    (row,) = report.rows
    assert row.raw["success"] == [float(seed % 3 == 0) for seed in range(20)]
    assert "told the wrong instruction" in report.title
    assert "told the wrong instruction" in report.summary[0]


def test_episodes_are_spread_evenly_over_the_tasks(int8_bundle, policy_template):
    assert evaluated(int8_bundle, policy_template, episodes=3).rows[0].get("success").samples == 4


def test_progress_tells_episodes_and_success(int8_bundle, policy_template):
    told = []
    context = Context(lambda what, share: told.append((what, share)))
    ClosedLoop(policy=policy_template, episodes=20, first_seed=0).run(int8_bundle, context)
    assert told == [
        ("10 of 20 episodes: 80.0 % succeed (49.0 to 94.3)", 0.5),
        ("20 of 20 episodes: 80.0 % succeed (58.4 to 91.9)", 1.0),
    ]


def test_a_bundle_that_names_its_environment_needs_no_description(int8_bundle, policy_template):
    environment = f"{policy_template / 'environment.py'}:make"
    stage = ClosedLoop(environment=environment, episodes=2, first_seed=1)
    assert stage.run(int8_bundle, Context()).rows[0].value("success") == 1.0
    assert stage.inputs() == (policy_template / "environment.py", policy_template / "policy.py")


def test_the_baseline_and_the_environments_file_belong_to_the_key(float_bundle, policy_template):
    stage = ClosedLoop(policy=policy_template, baseline=float_bundle.path)
    code = (policy_template / "environment.py", policy_template / "policy.py")
    assert stage.inputs() == (float_bundle.path / "manifest.json", *code)


@pytest.mark.parametrize("workers", [1, 2])
def test_an_environment_that_raises_is_named_with_its_task_and_seed(int8_bundle, world, workers):
    stage = ClosedLoop(environment=world("1 / 0"), tasks=("reach",), episodes=2, first_seed=7)
    with pytest.raises(DataError, match=r"task 'reach' failed at seed 7: ZeroDivisionError: division by zero"):
        stage.run(int8_bundle, Context(workers=workers))


def test_an_environment_that_never_ends_is_left(int8_bundle, world, monkeypatch):
    monkeypatch.setattr(play, "STEP_LIMIT", 50)
    stage = ClosedLoop(environment=world(), tasks=("reach",), episodes=1, first_seed=3)
    with pytest.raises(DataError, match=r"task 'reach' did not end within 50 steps at seed 3"):
        stage.run(int8_bundle, Context())


def test_an_observation_that_does_not_fit_is_the_policys_error(int8_bundle, world):
    stage = ClosedLoop(environment=world("return {}, 0.0, False, False, {}"), tasks=("reach",), episodes=1)
    with pytest.raises(DataError, match="The observation has no 'image'"):
        stage.run(int8_bundle, Context())


def test_a_worker_that_dies_is_said(int8_bundle, world):
    stage = ClosedLoop(environment=world("import os; os._exit(1)"), tasks=("reach",), episodes=1)
    with pytest.raises(SourceError, match=r"world.py ended its process with exit code 1 before it was done"):
        stage.run(int8_bundle, Context(workers=2))


def test_an_inference_that_takes_too_long_is_stopped(int8_bundle, monkeypatch):
    observation = observations_for(int8_bundle, 1)[0]
    jobs = [play.EpisodesJob("", "", "", (), **options) for options in ({}, {"latency_ms": 1e3})]
    assert [play.Worker(str(int8_bundle.path), "").controller(job).act(observation).shape for job in jobs] == [(2,)] * 2
    monkeypatch.setattr(play, "FIRST_RUN_S", -1.0)
    worker = play.Worker(str(int8_bundle.path), "")
    for job in jobs:
        with pytest.raises(GraphError, match="takes longer than -1 s, so it was stopped"):
            worker.controller(job).act(observation)
    with pytest.raises(GraphError, match="takes longer than -1 s, so it was stopped"):
        worker.controller(play.EpisodesJob("", "", "", (), control="random"))


def test_one_environment_is_open_at_a_time(float_bundle, int8_bundle, world):
    """Some renderers allow no more; both bundles of a pair play in this process."""
    ends = "return self.reset()[0], 0.0, True, False, {'success': True}"
    stage = ClosedLoop(environment=world(ends), tasks=("reach", "push"), episodes=4, baseline=float_bundle.path)
    assert stage.run(int8_bundle, Context()).rows[1].value("success") == 1.0


@pytest.mark.parametrize(
    ("options", "error", "says"),
    [
        ({"tasks": ("raech",)}, UsageError, "There is no task 'raech'; did you mean 'reach'"),
        ({"environment": "none.py:make"}, SourceError, r"No such file: .*none.py \(--environment none.py:make\)"),
        ({"environment": "environment.py:mak"}, SourceError, "did you mean 'make'"),
        ({"environment": "environment.py"}, SourceError, "names a file but no function"),
        ({"environment": "no_such_package.module:make"}, MissingExtra, "no_such_package"),
    ],
)
def test_what_is_named_wrongly_is_said(int8_bundle, policy_template, options, error, says):
    with pytest.raises(error, match=says):
        evaluated(int8_bundle, policy_template, **options)


def test_without_environment_or_tasks_the_remedy_is_named(int8_bundle):
    from dataclasses import replace

    from vlatool.bundle.bundle import Bundle

    bare = Bundle(int8_bundle.path, replace(int8_bundle.manifest, environment={}))
    for stage in (ClosedLoop(), ClosedLoop(environment="a.py:make"), ClosedLoop(tasks=("reach",))):
        with pytest.raises(DataError, match="No environment or no tasks") as caught:
            stage.check(bare, None)
        assert "--policy DIR" in caught.value.fix


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"controller": "lat"}, "Unknown controller 'lat'; did you mean 'late'"),
        ({"controller": "chunked, late"}, "Both chunked and late play the chunks"),
        ({"controller": "chunked", "latency_in_the_loop": True}, "The controller chunked waits for each inference"),
        ({"controller": "rtc:delay=-1"}, "delay is -1; allowed: a whole number from 0"),
        ({"controller": "start_pose"}, "0 inputs have the"),
        ({"controller": "rtc:background=true"}, "depends on the speed of this machine"),
        ({"controller": "dual_rate"}, "has no slow part"),
        ({"controller": "dual_rate:thread=true"}, "depends on the speed of this machine"),
        ({"controller": "asynchronous:memory=3:background=true"}, "depends on the speed of this machine"),
        ({"controller": "deadline:deadline_ms=5,late"}, "What a deadline does depends on the speed of this machine"),
        ({"controller": "rtc:background=true", "latency_in_the_loop": True}, "depends on the speed of this machine"),
        ({"controller": "chunked:execute=99"}, "execute is 99; allowed: a whole number from 0 to"),
        ({"controller": "late", "control": "random"}, "--controller is of inferences, and random actions need none"),
        ({"latency_in_the_loop": True, "control": "random"}, "--latency-in-the-loop is of inferences, and random"),
    ],
)
def test_a_controller_that_cannot_play_is_refused_before_episodes(int8_bundle, policy_template, options, says):
    with pytest.raises(UsageError, match=says):
        ClosedLoop(policy=policy_template, **options).check(int8_bundle, None)


def test_jobs_come_back_in_their_order(int8_bundle, policy_template):
    jobs = [EpisodesJob("environment.py:make", str(policy_template), task, (2, 1)) for task in ("push", "reach")]
    outcomes = run_jobs(int8_bundle, jobs, "ort_cpu", Context(workers=2))
    assert [(each.task, each.seed) for each in outcomes] == [("push", 2), ("push", 1), ("reach", 2), ("reach", 1)]


def outcomes(*successes: bool, first: int = 0):
    return [Outcome("a", first + number, success, 3) for number, success in enumerate(successes)]


def test_lost_and_won_episodes_are_counted_pair_by_pair():
    base = success_row("baseline", "baseline", outcomes(True, True, True, True, False))
    row = compare_success(base, success_row("int8", "subject", outcomes(True, False, False, True, True)))
    assert row.value("success_drop") == pytest.approx(0.2)
    assert "2 lost, 1 won of 5 episodes" in row.get("success_drop").note
    assert row.value("mcnemar_p") == 1.0
    assert row.details["paired with the baseline"][0] == {
        "episodes": 5,
        "lost": 2,
        "won": 1,
        "drop": 0.2,
        "McNemar exact p": 1.0,
    }


def test_other_seeds_are_not_paired():
    one = success_row("a", "baseline", outcomes(True))
    other: Row = success_row("b", "subject", outcomes(True, first=9))
    with pytest.raises(DataError, match="did not play the same episodes"):
        compare_success(one, other)


def test_episodes_that_begin_alike_have_one_start(int8_bundle, policy_template, world):
    """The world of a seed shows in its first observation, or it does not."""
    ends = "return self.reset()[0], 0.0, True, False, {'success': True}"
    alike = ClosedLoop(environment=world(ends), tasks=("reach",), episodes=12).run(int8_bundle, Context())
    assert alike.rows[0].raw["start"] == [0.0] * 12
    assert alike.rows[0].get("success").low < 0.3, "as of one episode"
    assert any(
        "the 12 episodes have 1 distinct first observations, so that they count as 1" in w for w in alike.warnings
    )
    apart = evaluated(int8_bundle, policy_template, episodes=12)
    assert apart.rows[0].raw["start"] == [float(number) for number in range(12)]
    assert [line["distinct starts"] for line in apart.rows[0].details["success by task"]] == [6, 6]
    assert not any("distinct first" in warning for warning in apart.warnings)


def test_a_start_is_what_the_policy_is_given(int8_bundle):
    spec = int8_bundle.manifest.spec
    first = {"image": np.zeros((8, 8, 3), np.uint8), "proprio": [0.0, 1.0, 2.0], "instruction": "go"}
    same = {**first, "proprio": np.array([0.0, 1.0, 2.0]), "unseen": np.random.default_rng(1).random(3)}
    assert play.start_of(first, spec) == play.start_of(same, spec)
    others = ({"instruction": "stop"}, {"proprio": [0.0, 1.0, 2.5]}, {"image": np.ones((8, 8, 3), np.uint8)})
    assert len({play.start_of({**first, **other}, spec) for other in ({}, *others)}) == 4
