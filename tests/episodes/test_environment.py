"""What breaks gymnasium's contract, each told in a sentence with its remedy; and what may be left out of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests._flow import write_flow
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.episodes.environment import World
from vlatool.episodes.jobs import run_jobs
from vlatool.episodes.play import EpisodesJob
from vlatool.errors import DataError, SourceError
from vlatool.evaluate.closed_loop import ClosedLoop
from vlatool.export.onnx import ExportOnnx
from vlatool.runtime import load
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context
from vlatool.stage.run import run_transform

GOOD = """\
import numpy as np

def observation():
    return {"image": np.zeros((8, 8, 3), np.uint8), "proprio": np.zeros(3), "instruction": "go", "more": object()}

class World:
    def reset(self, *, seed=None, options=None):
        self.seed = seed
        return observation(), {}

    def step(self, action):
        return observation(), 1.0, True, False, {"success": True}

def make(task):
    return World()
"""
ONE = PolicySpec((TensorSpec("state", (1, 4)),), (TensorSpec("move", (1, 1, 2)),), 10.0, 1)


def played(folder, bundle, old: str = "", new: str = "", **options):
    """Play an episode in the good world, of which a part is another; the worlds are in files of their own."""
    assert old in GOOD
    (folder / "world.py").write_text(GOOD.replace(old, new) if old else GOOD)
    seeds = (5, 6, 7) if "self.seed" in new else (7,)
    return run_jobs(bundle, [EpisodesJob("world.py:make", str(folder), "reach", seeds, **options)], "", Context())


def test_a_good_world_is_played(tmp_path, float_bundle):
    (outcome,) = played(tmp_path, float_bundle)
    assert (outcome.success, outcome.steps) == (True, 1)


STEP = 'return observation(), 1.0, True, False, {"success": True}'
RESET = "return observation(), {}"
BROKEN = {
    "no environment": ("return World()", "return 5", "gives an int, which has no reset and no step", "gymnasium"),
    "no seed": ("*, seed=None, options=None", "", "takes no 'seed'", "seed=None"),
    "old reset": (RESET, "return observation()", "gives a dict; it must give (observation, info)", "gym's"),
    "old step": (STEP, "return observation(), 1.0, True, {}", "gives 4 values; it must give five", "done, False, info"),
    "step gives nothing": (STEP, "pass", "gives a NoneType; it must give five values", "done, False"),
    "reward only": (STEP, "return observation(), 1.0, True, False, {}", "never told whether", "a reward alone"),
    "success is a word": (STEP, STEP.replace('{"success": True}', "{'success': 'yes'}"), "'yes'", "True or False"),
    "a box": (
        RESET,
        "return np.zeros(4), {}",
        "float64 with the shape [4], without names; the policy takes image, proprio, instruction",
        "environment.md",
    ),
    "a box later": (STEP, "return np.zeros(4), 1.0, False, False, {}", "without names", "wrap it"),
    "no proprio": ('"proprio": np.zeros(3), ', "", "no 'proprio' (it has: image, instruction, more)", "trained on"),
    "another shape": ("np.zeros(3)", "np.zeros(5)", "The input 'proprio' has the shape [1, 5]", "trained on"),
    "another dtype": ("np.uint8", "np.float32", "The input 'image' is float32", "uint8"),
    "nan": ("np.zeros(3)", "np.full(3, np.nan)", "'proprio' holds 3 NaN of 3 values", "sensor"),
    "no text": ('"go"', "3", "'instruction' is text; got int", "pass a str"),
    "many at once": (STEP, "return observation(), 1.0, np.zeros(2), np.zeros(2), {}", "2 episodes at once", "single"),
    "terminated is a word": (
        STEP,
        STEP.replace("True, False", "'False', False"),
        "terminated of step() of the environment of task 'reach' is 'False'; allowed: true or false",
        "bool(",
    ),
    "terminated is nan": (STEP, STEP.replace("True, False", "np.nan, True"), "terminated of step() of", "bool("),
    "truncated is None": (STEP, STEP.replace("True, False", "True, None"), "truncated of step() of", "bool("),
    "truncated is 2": (STEP, STEP.replace("True, False", "False, np.array([2])"), "truncated of step() of", "bool("),
    "raises": (STEP, "return [][1]", "failed at seed 7: IndexError: list index out of range", "reset(seed=7)"),
    "raises in reset": (
        RESET,
        "raise RuntimeError('no display')",
        "failed at seed 7: RuntimeError: no display",
        "VLATOOL_DEBUG=1",
    ),
    "raises much": (STEP, "raise ValueError('z' * 10**7)", "zz... (10,000,000 characters).", "correct what fails"),
    "raises vlatool's": (
        STEP,
        "from vlatool.errors import DataError; raise DataError('bad')",
        "at seed 7: bad",
        "make(",
    ),
    "cannot disturb": (
        "def reset(",
        "disturbances = ('push',)\n    def disturb(self, *_):\n        [][1]\n    def reset(",
        "failed at seed 7 under push, strength 1: IndexError",
        "call e = make(task='reach'), then e.disturb('push', 1, 7) and e.reset(seed=7) of the environment yourself",
    ),
    "disturbed into another shape": (
        "def reset(",
        "disturbances = ('push',)\n    def disturb(self, *_): self.reset = lambda seed: ({}, {})\n    def reset(",
        "Under push, strength 1: The environment, in task 'reach' at seed 7, step 1, gives",
        "",
    ),
    "too large": ("np.zeros(3)", "np.full(3, 1e300)", "too large for float32", "unit"),
}
ENDS = {
    "sys.exit": ("sys.exit(3)", "called sys.exit(3)", "raise an exception"),
    "os._exit": ("os._exit(0)", "ended its process with exit code 0", "raise an exception"),
    "a crash": ("os.abort()", "crashed its process (SIGABRT)", "library that crashes"),
    "KeyboardInterrupt": ("raise KeyboardInterrupt", "raised KeyboardInterrupt", "raise an Exception"),
    "nonsense": ("[os.write(fd, b'rubbish\\n' * 9) for fd in range(3, 30) if os.path.exists(f'/proc/self/fd/{fd}')]",
                 "answered nonsense", "its own files"),
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN)
def test_a_breach_of_the_contract_is_told_with_its_remedy(tmp_path, float_bundle, name):
    old, new, says, fix = BROKEN[name]
    with pytest.raises(DataError) as caught:
        played(tmp_path, float_bundle, old, new, disturb="push" if "disturb" in name else "")
    assert says in caught.value.message
    assert fix in caught.value.fix
    assert caught.value.message.count("task 'reach'") == 1
    assert caught.value.message.count("seed 7") == (name not in ("no environment", "no seed"))
    assert len(caught.value.message) < 3000


@pytest.mark.parametrize("name", ENDS)
def test_an_end_of_the_process_is_told_with_its_task_and_the_seed_at_which_it_came(tmp_path, float_bundle, name):
    does, says, fix = ENDS[name]
    with pytest.raises(SourceError) as caught:
        played(
            tmp_path,
            float_bundle,
            STEP,
            f"import os, sys\n        if self.seed == 6:\n            {does}\n        {STEP}",
        )
    assert says in caught.value.message
    assert fix in caught.value.fix
    assert "task 'reach'" in caught.value.message
    assert "seed 6" in caught.value.message


class Box:
    """A plain environment: bare observations."""

    def reset(self, *, seed=None):
        return np.arange(4.0), {}

    def step(self, action):
        return np.arange(4.0), 0.0, np.bool_(False), np.array([True]), {}


def test_a_bare_observation_is_that_of_the_only_input():
    world = World(Box(), "any", ONE)
    np.testing.assert_array_equal(world.reset(3)[0]["state"], np.arange(4.0))
    observation, over, _ = world.step(0)
    assert list(observation) == ["state"]
    assert over is True


@pytest.mark.parametrize("value", [True, np.bool_(True), 1, 1.0, np.array(1), np.array([True]), [True]], ids=repr)
def test_all_that_means_true_ends_an_episode_and_all_that_means_false_does_not(value):
    class Told(Box):
        flags = (False, False)

        def step(self, action):
            return np.arange(4.0), 0.0, *self.flags, {}

    box = Told()
    world = World(box, "any", ONE)
    no = type(value)([0]) if isinstance(value, list) else value * 0
    for box.flags, over in (((value, no), True), ((no, value), True), ((no, no), False)):
        assert world.step(0)[1] is over


def test_a_plain_gymnasium_environment_is_played_by_a_policy_with_one_input():
    gymnasium = pytest.importorskip("gymnasium")
    world = World(gymnasium.make("CartPole-v1"), "CartPole-v1", ONE)
    first = world.reset(3)[0]["state"]
    assert first.shape == (4,)
    np.testing.assert_array_equal(world.reset(3)[0]["state"], first)
    assert world.step(1)[1] is False


def test_a_reset_that_hides_its_parameters_is_believed():
    class Hidden(Box):
        def reset(self, *given, **named):
            return Box.reset(self, **named)

    assert list(World(Hidden(), "any", ONE).reset(1)[0]) == ["state"]


FLOW_WORLD = """\
import numpy as np

class World:
    def reset(self, *, seed=None):
        self.first = []
        return {"state": np.ones(3, np.float32)}, {}

    def step(self, action):
        return {"state": np.ones(3, np.float32)}, 0.0, True, False, {"success": bool(action[0] > THRESHOLD)}

def make(task):
    return World()
"""


def test_each_episode_has_noise_of_its_own_and_every_variant_the_same(tmp_path: Path):
    """The world is always the same: only the noise can make one episode succeed and another fail."""
    folder = write_flow(tmp_path / "flow")
    source = run_transform(TorchModule(policy=folder), None, tmp_path / "module", Context()).bundle
    bundle = run_transform(ExportOnnx(), source, tmp_path / "bundle", Context()).bundle
    policy = load(bundle.path, seed=3)
    firsts = []
    for seed in range(8):
        policy.reset(seed)
        firsts.append(float(policy.infer({"state": np.ones(3, np.float32)}).chunk[0, 0]))
    assert len(set(firsts)) == 8
    threshold = sorted(firsts)[3]
    (folder / "world.py").write_text(FLOW_WORLD.replace("THRESHOLD", repr(threshold)))
    stage = ClosedLoop(environment=f"{folder / 'world.py'}:make", tasks=("any",), episodes=8, first_seed=0,
                       baseline=bundle.path)  # fmt: skip
    for row in stage.run(bundle, Context(workers=2)).rows:
        assert row.raw["success"] == [float(first > threshold) for first in firsts]
