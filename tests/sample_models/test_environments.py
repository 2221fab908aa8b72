"""The samples' environments: what they tell of the robot, and how they can be disturbed."""

import importlib.util
import itertools
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

SAMPLES = Path(__file__).parents[2] / "sample_models"
NEEDS = {"vla-metaworld": "metaworld", "vln-babyai": "minigrid"}
TASKS = {"vla-metaworld": "drawer-open", "vln-babyai": "GoToLocalS8N4"}
KINDS = {
    "vla-metaworld": ("start_pose", "camera_shift", "light", "sensor_noise", "wording"),
    "vln-babyai": ("start_pose", "camera_shift", "light", "sensor_noise", "wording", "occlusion"),
}
LADDER = ("S5N2", "S6N2", "S6N3", "S6N4", "S7N4", "S8N4", "")  # forty held-out episodes of each, from seed 2,000,000
FIRST_RECORDED = 2_000_000
LEFT, RIGHT, FORWARD = range(3)
ALL = [pytest.param(sample, kind, id=f"{sample}-{kind}") for sample, kinds in KINDS.items() for kind in kinds]
Seen = dict[str, Any]


@pytest.fixture(scope="module")
def modules() -> Iterator[dict[str, ModuleType]]:
    """The samples' environment.py that were imported, each under a name of its own; gone afterwards."""
    imported: dict[str, ModuleType] = {}
    yield imported
    for module in imported.values():
        del sys.modules[module.__name__]


@pytest.fixture(scope="module")
def made(modules: dict[str, ModuleType]) -> Iterator[dict[str, Any]]:
    """One environment of each sample that was asked for: a Meta-World simulation takes a while to be made."""
    environments: dict[str, Any] = {}
    yield environments
    for environment in environments.values():
        environment.close()


def imported(sample: str, modules: dict[str, ModuleType]) -> ModuleType:
    """Import a sample's environment.py, or skip the test where its simulator is missing."""
    pytest.importorskip(NEEDS[sample])
    if sample not in modules:
        name = f"environment_of_{sample.replace('-', '_')}"
        spec = importlib.util.spec_from_file_location(name, SAMPLES / sample / "environment.py")
        assert spec is not None
        assert spec.loader is not None
        modules[sample] = sys.modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(modules[sample])
    return modules[sample]


@pytest.fixture
def world(request: pytest.FixtureRequest, modules: dict[str, ModuleType], made: dict[str, Any]) -> Any:
    """The environment of the sample that a test names, undisturbed."""
    sample = getattr(request, "param", None) or request.node.callspec.params["sample"]
    module = imported(sample, modules)
    if sample not in made:
        made[sample] = module.make(TASKS[sample])
    if sample == "vla-metaworld":
        try:
            made[sample].reset(seed=0)[0]["image"]
        except RuntimeError as error:  # no headless rendering
            pytest.skip(str(error))
    made[sample].disturb("light", 0.0, 0)
    return made[sample]


babyai = pytest.mark.parametrize("world", ["vln-babyai"], indirect=True)
metaworld = pytest.mark.parametrize("world", ["vla-metaworld"], indirect=True)
both = pytest.mark.parametrize("sample", KINDS)


def copied(observation: Any) -> Seen:
    """An observation whose image is rendered now."""
    return {name: np.array(observation[name]) for name in observation}


def played(world: Any, seed: int = 3) -> list[Seen]:
    """The first observations of an episode in which the robot moves."""
    action = FORWARD if world.action_space.shape == () else np.array([0.004, 0.0, -0.002, 0.3], np.float32)
    return [copied(world.reset(seed=seed)[0]), *(copied(world.step(action)[0]) for _ in range(2))]


def same(one: list[Seen], other: list[Seen]) -> bool:
    """Say whether two episodes look the same, bit for bit."""
    return all(np.array_equal(a[name], b[name]) for a, b in zip(one, other, strict=True) for name in a)


@both
def test_an_environment_names_its_disturbances(sample: str, world: Any) -> None:
    assert world.disturbances == KINDS[sample]


@pytest.mark.parametrize(("sample", "kind"), ALL)
def test_strength_nought_changes_nothing(kind: str, sample: str, world: Any) -> None:
    before = played(world)
    world.disturb(kind, 0.0, 5)
    assert same(played(world), before)


@pytest.mark.parametrize(("sample", "kind"), ALL)
def test_a_disturbance_is_named_by_its_seed(kind: str, sample: str, world: Any) -> None:
    before = played(world)
    found = []
    for seed in (0, 1, 2, 3, 4, 0):
        world.disturb(kind, 1.0, seed)
        found.append(played(world))
    assert not any(same(disturbed, before) for disturbed in found)
    assert same(found[0], found[-1])
    assert not all(same(found[0], other) for other in found[1:-1])
    for disturbed, undisturbed in itertools.product(found[0], before):
        assert {name: (v.dtype.kind, v.shape) for name, v in disturbed.items()} == {
            name: (v.dtype.kind, v.shape) for name, v in undisturbed.items()
        }


@pytest.mark.parametrize(("sample", "kind"), ALL)
def test_twice_the_strength_is_possible(kind: str, sample: str, world: Any) -> None:
    world.disturb(kind, 1.0, 1)
    once = played(world)
    world.disturb(kind, 2.0, 1)
    assert kind == "start_pose" or not same(played(world), once)


@both
def test_a_disturbance_begins_with_the_next_reset_and_lasts(sample: str, world: Any) -> None:
    before = played(world)
    world.reset(seed=3)
    world.disturb("light", 2.0, 1)
    action = FORWARD if sample == "vln-babyai" else np.array([0.004, 0.0, -0.002, 0.3], np.float32)
    assert same([copied(world.step(action)[0])], before[1:2])
    first = played(world)
    assert not same(first, before)
    assert same(played(world), first)
    world.disturb("light", 0.0, 1)
    assert same(played(world), before)


@both
def test_what_is_no_disturbance_is_refused(sample: str, world: Any) -> None:
    with pytest.raises(ValueError, match="unknown disturbance 'earthquake'; known: start_pose, camera_shift, light"):
        world.disturb("earthquake", 1.0, 0)
    for strength in (-1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="must be 0 or more"):
            world.disturb("light", strength, 0)


@metaworld
def test_the_arm_tells_how_it_stands(world: Any) -> None:
    world.disturb("sensor_noise", 1.0, 1)
    observation, info = world.reset(seed=3)
    model, data = world.simulation.model, world.simulation.data
    for _ in range(3):
        assert info["position"].shape == (3,)
        assert info["joints"].shape == (7,)
        np.testing.assert_array_equal(info["position"], data.body("hand").xpos)
        np.testing.assert_array_equal(info["joints"], [data.joint(f"right_j{index}").qpos[0] for index in range(7)])
        lowest, highest = np.transpose([model.joint(f"right_j{index}").range for index in range(7)])
        assert np.all((lowest <= info["joints"]) & (info["joints"] <= highest))
        assert info["gripper"] == pytest.approx(observation["proprio"][3])
        assert 0 < np.abs(observation["proprio"][:3] - info["position"]).max() < 0.03  # the sensor's noise is not told
        observation, _, _, _, info = world.step(np.array([0.01, 0, 0, 1], np.float32))
    assert "shortest_path" not in info


@metaworld
def test_an_undisturbed_arm_moves_as_meta_world_moves_it(world: Any, modules: dict[str, ModuleType]) -> None:
    world.disturb("start_pose", 2.0, 1)
    world.reset(seed=4)
    world.disturb("start_pose", 0.0, 1)
    command = np.array([0.4, 0.2, -0.3, 0.5])
    world.reset(seed=4)
    found = [world.step(command * [0.01, 0.01, 0.01, 1])[0]["proprio"] for _ in range(3)]
    simulation = modules["vla-metaworld"]._make_simulation(TASKS["vla-metaworld"])
    simulation.seed(4)
    simulation.reset()
    wanted = [simulation.step(command)[0] for _ in range(3)]
    np.testing.assert_allclose(found, [state[:4] for state in wanted], atol=1e-6)


@metaworld
def test_the_hand_really_starts_elsewhere(world: Any) -> None:
    objects = world.simulation.data.qpos.size
    usual = world.reset(seed=3)[1]["position"]
    drawer = world.simulation.data.qpos[9:objects].copy()
    for seed in range(4):
        world.disturb("start_pose", 1.0, seed)
        observation, info = world.reset(seed=3)
        assert 0.045 < np.linalg.norm(info["position"] - usual) < 0.055  # 5 cm, and it stands there
        assert info["position"][2] > usual[2] - 0.005
        np.testing.assert_allclose(observation["proprio"][:3], info["position"], atol=1e-6)
        np.testing.assert_allclose(world.simulation.data.qpos[9:objects], drawer, atol=1e-6)  # the scene is the seed's
        _, _, _, _, after = world.step(np.array([0, 0, 0, -1], np.float32))
        assert np.linalg.norm(after["position"] - info["position"]) < 0.001


@metaworld
def test_the_same_words_are_said_in_another_way(world: Any, modules: dict[str, ModuleType]) -> None:
    module = modules["vla-metaworld"]
    trained = {sentence for sentences in module.INSTRUCTIONS.values() for sentence in sentences}
    known = {word for sentence in trained for word in sentence.split()}
    assert module.REWORDED.keys() == module.INSTRUCTIONS.keys()
    for sentences in module.REWORDED.values():
        assert not trained & set(sentences)
        assert {word for sentence in sentences for word in sentence.split()} <= known
    told = [module.Disturbance("wording", 0.5, seed).instruction("door-open", "open the door") for seed in range(100)]
    assert 30 < told.count("open the door") < 70


@babyai
def test_recorded_episodes_are_what_they_were(world: Any, modules: dict[str, ModuleType]) -> None:
    recorded = np.load(SAMPLES / "vln-babyai" / "evaluation.npz")
    early = np.flatnonzero(recorded["actions"][:, 0] == 3)[::6]  # fewer steps than the history is long: all is known
    images, instructions = recorded["image"], recorded["instruction"]
    assert len(early) > 20
    for row in early:
        seed = int(recorded["episode"][row])
        environment = modules["vln-babyai"].make(f"GoToLocal{LADDER[(seed - FIRST_RECORDED) // 40]}")
        observation, _ = environment.reset(seed=seed)
        for action in recorded["actions"][row]:
            if action != 3:
                observation = environment.step(action)[0]
        np.testing.assert_array_equal(observation["image"], images[row])
        assert observation["instruction"] == instructions[row]


@babyai
def test_the_agent_tells_where_it_is(world: Any) -> None:
    random = np.random.default_rng(0)
    collisions = 0
    for seed in range(20):
        _, info = world.reset(seed=seed)
        assert "collision" not in info
        over = False
        while not over:
            before, action = info, int(random.choice([LEFT, FORWARD, FORWARD, FORWARD]))
            _, _, terminated, truncated, info = world.step(action)
            over = terminated or truncated
            moved = info["position"] - before["position"]
            forward = np.rint([math.cos(before["heading"]), math.sin(before["heading"])])
            assert info["position"].shape == (2,)
            assert info["heading"] == world.level.agent_dir * math.pi / 2
            assert isinstance(info["collision"], bool)
            assert np.array_equal(moved, forward) or not moved.any()
            assert moved.any() == (action == FORWARD and not info["collision"] and not (terminated and not moved.any()))
            collisions += info["collision"]
    assert collisions > 0


@babyai
@pytest.mark.parametrize("strength", [0.0, 2.0])
def test_the_shortest_path_is_that_of_an_exhaustive_search(strength: float, world: Any) -> None:
    found = []
    for seed in range(40):
        world.disturb("start_pose", strength, seed)
        told = world.reset(seed=seed)[1]["shortest_path"]
        assert told == exhaustive_search(world.level)
        found.append(told)
    assert {1.0, 2.0, 3.0} <= set(found)
    assert strength == 0 or 0.0 in found


def exhaustive_search(level: Any) -> float:
    """Moves to where the level itself grants success, asking it about every step from every cell."""
    start = tuple(map(int, level.agent_pos))
    headings = range(4)
    cells = [
        cell for cell in itertools.product(range(level.width), range(level.height)) if level.grid.get(*cell) is None
    ]
    steps, solved = [], set()
    for cell, level.agent_dir in itertools.product(cells, headings):
        level.agent_pos = cell
        if level.instrs.verify(LEFT) == "success":
            solved.add(cell)
        level.step(FORWARD)
        steps.append((cell, tuple(map(int, level.agent_pos))))
    moves = {cell: 0.0 if cell == start else math.inf for cell in cells}
    for _ in cells:
        for one, other in steps:
            moves[other] = min(moves[other], moves[one] + 1)
    return min(moves[cell] for cell in solved)


@babyai
def test_another_start_is_near_and_unsolved_in_the_same_room(world: Any) -> None:
    for seed in range(30):
        world.disturb("start_pose", 0.0, seed)
        _, usual = world.reset(seed=seed)
        room = world.level.grid.encode()
        world.disturb("start_pose", 1.0, seed)
        _, info = world.reset(seed=seed)
        np.testing.assert_array_equal(world.level.grid.encode(), room)
        assert info["mission"] == usual["mission"]
        assert np.abs(info["position"] - usual["position"]).sum() <= 2
        assert world.level.grid.get(*world.level.agent_pos) is None
        assert math.isfinite(info["shortest_path"])
        assert world.level.instrs.verify(LEFT) == "continue"


@babyai
def test_a_frame_keeps_its_noise(world: Any) -> None:
    world.disturb("sensor_noise", 1.0, 1)
    first = world.reset(seed=3)[0]["image"]
    assert not first[:-1].any()  # what was never seen has none
    np.testing.assert_array_equal(world.step(LEFT)[0]["image"][-2], first[-1])
