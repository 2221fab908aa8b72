"""LeRobot checkpoints read as data: features, statistics, what is refused; tracing needs LeRobot itself.

``tests/validation/foreign/lerobot_checkpoints.py`` traces real checkpoints with LeRobot and compares whole actions.
"""

import copy
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from _checkpoint_files import edited, write

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import SourceError
from vlatool.machine.host import LEROBOT_PYTHON
from vlatool.registry import Claim
from vlatool.runtime.control import layers
from vlatool.runtime.control.temporal_ensemble import TemporalEnsemble
from vlatool.runtime.converter import action_converter
from vlatool.runtime.observation import ObservationEncoder
from vlatool.runtime.statistics import load_normaliser
from vlatool.sources import _lerobot_directory as directory
from vlatool.sources import source_stage
from vlatool.sources._lerobot_checkpoint import read_checkpoint
from vlatool.sources._lerobot_conversions import STATE_IN_PROMPT
from vlatool.sources.lerobot import LerobotCheckpoint

STATE = {"type": "STATE", "shape": [3]}
CAMERA = {"type": "VISUAL", "shape": [3, 8, 12]}
ACTION = {"type": "ACTION", "shape": [2]}
NORMS = {"VISUAL": "MEAN_STD", "STATE": "MEAN_STD", "ACTION": "MIN_MAX"}
CONFIG = {
    "type": "act", "n_obs_steps": 1, "chunk_size": 4, "n_action_steps": 2, "temporal_ensemble_coeff": None,
    "normalization_mapping": NORMS,
    "input_features": {"observation.state": STATE, "observation.images.top": CAMERA},
    "output_features": {"action": ACTION},
}  # fmt: skip
FEATURES = {**CONFIG["input_features"], "action": ACTION}
STATS = {
    "observation.state.mean": [0.5, -1, 2], "observation.state.std": [0.1, 0, 3],
    "observation.images.top.mean": [[[0.485]], [[0.456]], [[0.406]]],
    "observation.images.top.std": [[[0.229]], [[0.224]], [[0.225]]],
    "action.min": [-1, 0.25], "action.max": [3, 0.25],
}  # fmt: skip


def normalizer(name: str, features: dict[str, Any]) -> dict[str, Any]:
    step = {"unnormalizer": "postprocessor_step_0", "normalizer": "preprocessor_step_3"}[name]
    config = {"eps": 1e-8, "features": features, "norm_map": dict(NORMS)}
    file = f"policy_{step}_{name}_processor.safetensors"
    return {"registry_name": f"{name}_processor", "config": config, "state_file": file}


def parts() -> dict[str, Any]:
    """Return the files of a checkpoint as saved by LeRobot 0.6.1: name -> JSON, or tensors."""
    before = [
        {"registry_name": "rename_observations_processor", "config": {"rename_map": {}}},
        {"registry_name": "to_batch_processor", "config": {}},
        {"registry_name": "device_processor", "config": {"device": "cpu", "float_dtype": None}},
        normalizer("normalizer", FEATURES),
    ]
    return {
        "config.json": copy.deepcopy(CONFIG),
        "policy_preprocessor.json": {"name": "policy_preprocessor", "steps": before},
        "policy_postprocessor.json": {"name": "", "steps": [normalizer("unnormalizer", {"action": ACTION})]},
        "policy_preprocessor_step_3_normalizer_processor.safetensors": dict(STATS),
        "policy_postprocessor_step_0_unnormalizer_processor.safetensors": dict(STATS),
        "model.safetensors": {"w": [0.0]},
    }


def test_features_and_statistics_are_those_of_the_processors(tmp_path: Path) -> None:
    checkpoint = read_checkpoint(write(tmp_path / "c", parts()))
    assert (checkpoint.family, checkpoint.execute, list(checkpoint.inputs)) == (
        "act",
        2,
        list(CONFIG["input_features"]),
    )
    top = checkpoint.inputs["observation.images.top"]
    assert (top.kind, top.shape, top.mode) == ("VISUAL", (3, 8, 12), "MEAN_STD")
    np.testing.assert_allclose(top.statistics["mean"], [0.485, 0.456, 0.406], rtol=1e-6)
    assert checkpoint.action.mode == "MIN_MAX"


def test_a_camera_has_the_name_that_the_robot_uses(tmp_path: Path) -> None:
    files = parts()
    files["policy_preprocessor.json"]["steps"][0]["config"] = {
        "rename_map": {"observation.images.left": "observation.images.top"}
    }
    checkpoint = read_checkpoint(write(tmp_path / "c", files))
    assert checkpoint.inputs["observation.images.top"].key == "observation.images.left"


@pytest.mark.parametrize(("key", "mode"), [("observation.state", "mean_std"), ("action", "min_max")])
def test_statistics_do_what_lerobot_does_and_a_joint_that_never_moved_is_not_an_error(
    tmp_path: Path, key: str, mode: str
) -> None:
    checkpoint = read_checkpoint(write(tmp_path / "c", parts()))
    feature = {**checkpoint.inputs, "action": checkpoint.action}[key]
    (tmp_path / "statistics.json").write_text(json.dumps({key: directory._rows(feature)}))
    first, second = (np.asarray(values, np.float64) for values in feature.statistics.values())
    tensor = TensorSpec(key, (1, len(first)), **directory._tensor(feature))
    assert (tensor.normalisation, tensor.epsilon) == (mode, 1e-8)
    normaliser = load_normaliser(tensor, tmp_path)
    normalised = np.linspace(-1, 1, len(first))[None].astype(np.float32)
    if mode == "mean_std":
        physical = first + np.array([[0.3, 0, -2]])
        expected = (physical - first) / (second + 1e-8)
        np.testing.assert_allclose(normaliser.forward(physical.astype(np.float32)), expected, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(normaliser.inverse(normalised), normalised * second + first, rtol=1e-5, atol=1e-7)
    else:
        spread = np.where(second == first, 1e-8, second - first)
        expected = (normalised + 1) / 2 * spread + first
        np.testing.assert_allclose(normaliser.inverse(normalised), expected, rtol=1e-5, atol=1e-7)
        assert normaliser.forward(np.float32([[-1, 0.25]])).tolist() == [[-1, -1]]


HOSTILE = 'c""" + __import__("os").system("touch pwned") + """'


@pytest.mark.parametrize("name", [HOSTILE, "c\n'''", "{name}", "a b"])
def test_the_name_of_a_directory_is_not_code(tmp_path: Path, name: str, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    checkpoint = read_checkpoint(write(tmp_path / name, parts()))
    facts = {"graphs": {"main": {"inputs": ["in_observation_state"]}}, "versions": {}}
    code = directory._code(facts)
    assert "pwned" not in code
    exec(compile(code, "policy.py", "exec"), {"__file__": str(tmp_path / "policy.py")})
    assert not (tmp_path / "pwned").exists()
    assert checkpoint.folder.name == name


def quantiles(files: dict[str, Any]) -> None:
    files["config.json"]["normalization_mapping"] = {**NORMS, "STATE": "QUANTILES"}
    files["policy_preprocessor.json"]["steps"][3]["config"]["norm_map"]["STATE"] = "QUANTILES"


def instruct(family: str, **config: Any) -> Callable[[dict[str, Any]], None]:
    """Return an edit that makes the policy one of that family, with the steps of its instruction."""

    def edit(files: dict[str, Any]) -> None:
        files["config.json"].update(type=family, **config)
        names = (f"{family}_new_line_processor", "tokenizer_processor")
        files["policy_preprocessor.json"]["steps"][2:2] = [{"registry_name": name, "config": {}} for name in names]

    return edit


def pi0(files: dict[str, Any], enabled: object = False) -> None:
    """Make the files those of pi0 as LeRobot 0.6.1 saves them: an instruction, and steps that do nothing."""
    instruct("pi0")(files)
    relative(place=5, enabled=enabled, absolute=enabled)(files)


def test_pi0_has_an_instruction_and_steps_that_are_not_enabled(tmp_path: Path) -> None:
    files = parts()
    pi0(files)
    checkpoint = read_checkpoint(write(tmp_path / "c", files))
    assert (checkpoint.family, checkpoint.inputs["observation.state"].mode) == ("pi0", "MEAN_STD")


@pytest.mark.parametrize("enabled", [None, 0, "no"])
def test_relative_actions_that_are_neither_on_nor_off_are_refused(tmp_path: Path, enabled: object) -> None:
    files = parts()
    pi0(files, enabled)
    with pytest.raises(SourceError, match="relative_actions_processor with enabled"):
        read_checkpoint(write(tmp_path / "c", files))


@pytest.mark.parametrize("number", [2, 3])
def test_an_instruction_that_is_not_processed_is_refused(tmp_path: Path, number: int) -> None:
    files = parts()
    pi0(files)
    gone = files["policy_preprocessor.json"]["steps"].pop(number)["registry_name"]
    with pytest.raises(SourceError, match=f"has no step '{gone}'"):
        read_checkpoint(write(tmp_path / "c", files))


def pi05(files: dict[str, Any], **config: Any) -> None:
    """Make the files those of pi0.5 as LeRobot 0.6.1 saves them: its prompt has the state, once that is normalised."""
    instruct("pi05")(files)
    steps = files["policy_preprocessor.json"]["steps"]
    del steps[2]
    prompt = {"registry_name": STATE_IN_PROMPT, "config": {"max_state_dim": 32, "task_key": "task", **config}}
    steps += [prompt, steps.pop(2)]


def lerobot_prompt(task: str, state: np.ndarray) -> str:
    """``Pi05PrepareStateTokenizerProcessorStep`` of LeRobot 0.6.1, of one normalised state."""
    discretized_states = np.digitize(state, bins=np.linspace(-1, 1, 256 + 1)[:-1]) - 1
    cleaned_text = task.strip().replace("_", " ").replace("\n", " ")
    return f"Task: {cleaned_text}, State: {' '.join(map(str, discretized_states))};\nAction: "


@pytest.mark.parametrize("robot_key", ["observation.state", "joints"])
def test_the_prompt_of_pi05_has_the_bins_of_the_state_as_lerobot_writes_them(tmp_path: Path, robot_key: str) -> None:
    files = parts()
    pi05(files)
    files["policy_preprocessor.json"]["steps"][0]["config"] = {"rename_map": {robot_key: "observation.state"}}
    checkpoint = read_checkpoint(write(tmp_path / "c", files))
    facts = {"graphs": {}, "program": [], "shapes": {key: [1, 3] for key in checkpoint.inputs}, "action": [1, 4, 2],
             "chunk": 4, "history": 1, "tokens": 9, "versions": {"lerobot": "0.6.1"}}  # fmt: skip
    spec = PolicySpec.from_dict(directory._description(checkpoint, facts)["spec"])
    (text,) = (each for each in spec.inputs if each.kind == "text")
    assert (text.prompt is not None, text.name_in_prompt) == (True, robot_key)
    random = np.random.default_rng(0)
    for task in ("pick {state} up", " open_the\ndrawer {}\n"):
        state = random.normal(size=3).astype(np.float32)
        assert text.prompt is not None
        assert text.prompt.write(task, state[None]) == lerobot_prompt(task, state)


def test_another_prompt_of_another_lerobot_is_refused(tmp_path: Path) -> None:
    files = parts()
    pi05(files)
    checkpoint = read_checkpoint(write(tmp_path / "c", files))
    state = [0.25, -1.0, 1.5]
    said = {"versions": {"lerobot": "0.4.0"}, "prompts": [("a", state, lerobot_prompt("a", np.float32(state)))]}
    directory._check_prompts(checkpoint, said)
    said["prompts"] = [("a", state, lerobot_prompt("a", np.float32([*state, 0, 0])))]
    with pytest.raises(SourceError, match=r"LeRobot 0\.4\.0 makes another prompt of 'a'.*160 0 255 128 128"):
        directory._check_prompts(checkpoint, said)


def without_state(files: dict[str, Any]) -> None:
    pi05(files)
    del files["config.json"]["input_features"]["observation.state"]


def before_its_statistics(files: dict[str, Any]) -> None:
    pi05(files)
    steps = files["policy_preprocessor.json"]["steps"]
    steps.insert(1, steps.pop(-2))


@pytest.mark.parametrize(("edit", "words"), [
    (without_state, "has no 'observation.state', which"), (before_its_statistics, "steps in the order"),
    (lambda files: pi05(files, task_key="goal"), f"has {STATE_IN_PROMPT} with task_key 'goal'"),
])  # fmt: skip
def test_a_pi05_that_lerobot_would_not_run_so_is_refused(
    tmp_path: Path, edit: Callable[[dict[str, Any]], None], words: str
) -> None:
    files = parts()
    edit(files)
    with pytest.raises(SourceError, match=words):
        read_checkpoint(write(tmp_path / "c", files))


def aloha_state(value: np.ndarray) -> np.ndarray:
    """SmolVLA's ``_pi_aloha_decode_state`` of LeRobot 0.6.1, in float32."""
    value = value * 1
    value[..., [1, 2, 8, 9]] *= -1
    for at in (6, 13):
        metres = value[..., at] * np.float32(0.058 - 0.01844) + np.float32(0.01844)
        sines = (0.022**2 + metres**2 - 0.036**2) / (2 * 0.022 * metres)
        value[..., at] = (np.arcsin(np.clip(sines, -1, 1)) - np.float32(0.4)) / np.float32(1.1)
    return value


def aloha_action(value: np.ndarray) -> np.ndarray:
    """Its ``_pi_aloha_encode_actions``."""
    value = value * 1
    value[..., [1, 2, 8, 9]] *= -1
    for at in (6, 13):
        value[..., at] = (value[..., at] * np.float32(1.1) + np.float32(0.4 + 0.6213)) / np.float32(1.491 + 0.6213)
    return value


@pytest.mark.parametrize("mode", ["IDENTITY", "MEAN_STD"])
def test_what_smolvla_does_for_aloha_is_data(tmp_path: Path, mode: str) -> None:
    files, wide = parts(), {"shape": [14]}
    norms = {"VISUAL": "IDENTITY", "STATE": mode, "ACTION": mode}
    config = {**CONFIG, "type": "smolvla", "adapt_to_pi_aloha": True, "normalization_mapping": norms}
    config["input_features"] = {"observation.state": {**STATE, **wide}}
    config["output_features"] = {"action": {**ACTION, **wide}}
    files["config.json"] = config
    mean, std = np.linspace(-1, 1, 14), np.linspace(0.5, 2, 14)
    for name, step in (("policy_preprocessor", -1), ("policy_postprocessor", 0)):
        settings = files[f"{name}.json"]["steps"][step]["config"]
        settings.update(norm_map=norms, features={**config["input_features"], **config["output_features"]})
    for file in [name for name in files if name.startswith("policy_") and name.endswith(".safetensors")]:
        files[file] = {f"{key}.{row}": value for key in ("observation.state", "action")
                       for row, value in (("mean", mean), ("std", std))}  # fmt: skip
    relative(exclude_joints=["x"])(files)
    instruct("smolvla")(files)
    checkpoint = read_checkpoint(write(tmp_path / "c", files))
    state, action = checkpoint.inputs["observation.state"], checkpoint.action
    rows = {each.key: directory._rows(each) for each in (state, action)}
    (tmp_path / "statistics.json").write_text(json.dumps(rows))
    said = [{"name": each.key, "shape": [1, 14], **directory._tensor(each)} for each in (state, action)]
    spec = PolicySpec.from_dict({"inputs": said[:1], "outputs": said[1:], "control_hz": 30})
    random = np.random.default_rng(0)
    seen, given = (random.uniform(0, 1, (1, 14)).astype(np.float32) for _ in range(2))
    offset, scale = (np.float32(mean), np.float32(std)) if mode == "MEAN_STD" else (np.float32(0), np.float32(1))
    encoded = ObservationEncoder(spec, tmp_path)({state.key: seen})
    np.testing.assert_allclose(encoded[state.key], aloha_state((seen - offset) / scale), atol=2e-5, rtol=1e-4)
    chunk = action_converter(spec, tmp_path).to_robot(given, seen[0])
    np.testing.assert_allclose(chunk, aloha_action(given) * scale + offset + seen, rtol=1e-5, atol=1e-6)


def relative(
    place: int = 3, behind: int = 1, absolute: Any = True, width: int = 2, **config: Any
) -> Callable[[dict[str, Any]], None]:
    """Return an edit after which actions are relative to the state."""

    def edit(files: dict[str, Any]) -> None:
        settings = {"enabled": True, "exclude_joints": [], "action_names": None, **config}
        step = {"registry_name": "relative_actions_processor", "config": settings}
        files["policy_preprocessor.json"]["steps"].insert(place, step)
        if absolute is not None:
            step = {"registry_name": "absolute_actions_processor", "config": {"enabled": absolute}}
            files["policy_postprocessor.json"]["steps"].insert(behind, step)
        if width != 2:
            files["config.json"]["output_features"]["action"] = {"type": "ACTION", "shape": [width]}
            name = "policy_postprocessor_step_0_unnormalizer_processor.safetensors"
            files[name] |= {"action.min": [-1] * width, "action.max": [1] * width}

    return edit


@pytest.mark.parametrize(
    ("config", "parts_of", "labels"),
    [
        ({}, [[0, 2]], ()),
        ({"exclude_joints": ["Grip"]}, [[0, 2]], ()),
        (
            {"exclude_joints": ["Grip"], "action_names": ["arm.pos", "gripper.pos"]},
            [[0, 1]],
            ("arm.pos", "gripper.pos"),
        ),
        ({"exclude_joints": ["arm"], "action_names": ["arm.pos"]}, [[1, 2]], ()),
        ({"exclude_joints": [""], "action_names": ["a", "b", "c"]}, [[0, 2]], ()),
        ({"exclude_joints": ["a"], "action_names": ["a1", "a2"]}, [], ("a1", "a2")),
        ({"enabled": False, "absolute": False, "action_names": ["a", "b"]}, [], ("a", "b")),
        ({"action_names": ["a", "a"]}, [[0, 2]], ()),
    ],
)
def test_relative_actions_are_a_step_of_the_spec(
    tmp_path: Path, config: dict[str, Any], parts_of: list[Any], labels: tuple[str, ...]
) -> None:
    files = parts()
    relative(**config)(files)
    action = read_checkpoint(write(tmp_path / "c", files)).action
    assert action.labels == labels
    assert [step["parts"] for step in action.convert] == ([parts_of] if parts_of else [])
    assert directory._tensor(action).get("mode") == ("absolute" if parts_of else None)
    TensorSpec.from_dict({"name": "action", "shape": [1, 4, 2], **directory._tensor(action)})


def ensembled(edit: Callable[[dict[str, Any]], None]) -> Callable[[dict[str, Any]], None]:
    """Return an edit after which the policy averages its chunks, too."""

    def both(files: dict[str, Any]) -> None:
        edit(files)
        files["config.json"] |= {"temporal_ensemble_coeff": 0.01, "n_action_steps": 1}

    return both


def test_a_policy_that_averages_its_chunks_says_which_controller_does(tmp_path: Path) -> None:
    files = parts()
    ensembled(lambda _: None)(files)
    checkpoint = read_checkpoint(write(tmp_path / "c", files))
    assert (checkpoint.ensemble, checkpoint.execute) == (0.01, 1)
    facts = {"shapes": {key: [1, 3] for key in checkpoint.inputs}, "history": 1, "tokens": 0, "chunk": 4,
             "action": [1, 4, 2], "program": [], "versions": {"lerobot": "0.6.1"}}  # fmt: skip
    said = directory._description(checkpoint, facts)
    assert said["description"].endswith("--controller temporal_ensemble:coefficient=0.01.")
    assert said["spec"]["execute"] == 1
    (wrapper,) = layers(["temporal_ensemble:coefficient=0.01"])
    assert wrapper is TemporalEnsemble
    assert read_checkpoint(write(tmp_path / "d", parts())).ensemble is None


INPUTS = ("config.json", "input_features")
STEPS = ("policy_preprocessor.json", "steps")
STATES = "policy_preprocessor_step_3_normalizer_processor.safetensors"


def text_step(turned: bool = False, **config: Any) -> Callable[[dict[str, Any]], None]:
    """Return an edit that makes the policy SmolVLA, with settings of its tokenizer, or with its steps turned around."""

    def edit(files: dict[str, Any]) -> None:
        instruct("smolvla", tokenizer_max_length=48)(files)
        steps = files["policy_preprocessor.json"]["steps"]
        steps[3]["config"] = config
        steps[2:4] = steps[3:1:-1] if turned else steps[2:4]

    return edit


BROKEN = {
    "unknown family": (edited("config.json", "type", to="tdmpc"), "of the type 'tdmpc'"),
    "ensembling of text": (edited("config.json", "temporal_ensemble_coeff", to="0.01"), "coeff '0.01'; allowed: null"),
    "ensembling of another": (instruct("smolvla", temporal_ensemble_coeff=0.01), "allowed: null, or a number for act"),
    "ensembling of differences": (ensembled(relative()), "relative to the states of different inferences"),
    "no features": (edited("config.json", "input_features", to={}), "has no input_features"),
    "features of text": (edited("config.json", "input_features", to={"a": "b"}), "has no input_features"),
    "negative shape": (edited(*INPUTS, "observation.state", "shape", to=[-3]), r"the shape \[-3\]"),
    "no shape": (edited(*INPUTS, "observation.state", "shape", to=None), "the shape None"),
    "two outputs": (
        edited("config.json", "output_features", to={"action": ACTION, "value": ACTION}), "has the outputs"
    ),
    "not JSON": (edited("config.json", to="{"), "is not valid JSON"),
    "a list": (edited("config.json", to="[]"), "holds no mapping"),
    "a NaN": (edited("policy_preprocessor.json", to='{"steps": NaN}'), "lists no steps"),
    "not normalised": (edited(*STEPS, 3, to=None), "its processors do IDENTITY"),
    "statistics of other keys": (
        edited(*STEPS, 3, "config", "normalize_observation_keys", to=["observation.images.top"]),
        "its processors do IDENTITY to 'observation.state'",
    ),
    "keys of text": (edited(*STEPS, 3, "config", "normalize_observation_keys", to="a"), "normalize_observation_keys"),
    "another kind": (
        edited(*STEPS, 3, "config", "features", to={**FEATURES, "observation.state": {"type": "ENV", "shape": [3]}}),
        "as 'ENV'",
    ),
    "renamed behind the statistics": (lambda files: files[STEPS[0]]["steps"].reverse(), "in the order normalizer"),
    "padding before the instruction": (text_step(padding_side="left"), "padding_side 'left'; wanted: right"),
    "an instruction of another length": (text_step(max_length=8), "max_length 8; wanted: 48"),
    "a line break behind the ids": (text_step(turned=True), "in the order tokenizer_processor"),
    "no preprocessor": (edited("policy_preprocessor.json", to=None), "has no policy_preprocessor.json"),
    "no postprocessor": (edited("policy_postprocessor.json", to=None), "has no policy_postprocessor.json"),
    "names that collide": (edited(*INPUTS, "observation_state", to=STATE), "of one name in the graph"),
    "rename map of text": (edited(*STEPS, 0, "config", "rename_map", to=["a"]), "rename_map"),
    "rename map of lists": (edited(*STEPS, 0, "config", "rename_map", to={"a": ["b"]}), "rename_map"),
    "two robot keys": (
        edited(*STEPS, 0, "config", "rename_map", to={"a": "observation.state", "b": "observation.state"}),
        "rename_map",
    ),
    "modes of text": (edited(*STEPS, 3, "config", "norm_map", to="MEAN_STD"), "norm_map"),
    "a step twice": (edited(*STEPS, 1, to=normalizer("normalizer", FEATURES)), "twice"),
    "corrupt statistics": (edited(STATES, to=b"\x08" + bytes(7) + b"{"), "cannot be read"),
    "empty statistics": (edited(STATES, to=b""), "cannot be read"),
    "epsilon of text": (edited(*STEPS, 3, "config", "eps", to="small"), "eps"),
    "no steps to execute": (edited("config.json", "n_action_steps", to=-2), "n_action_steps"),
    "code": (edited(*STEPS, 1, to={"class": "subprocess.Popen", "config": {"args": "touch pwned"}}), "that is code"),
    "a step of text": (edited(*STEPS, 1, to="to_batch_processor"), "that is code"),
    "unknown step": (edited(*STEPS, 1, "registry_name", to="evo1_pad_state_processor"), "evo1_pad_state_processor"),
    "relative alone": (relative(absolute=None), "actions would stay relative"),
    "absolute alone": (relative(enabled=False), "although none were made relative"),
    "relative to normalised states": (relative(place=4), "wrong side of the statistics"),
    "absolute before its statistics": (relative(behind=0), "wrong side of the statistics"),
    "relative to too few": (relative(width=4), "4 elements that are relative to 3"),
    "enabled by text": (relative(enabled="true"), "enabled 'true'"),
    "ALOHA of three joints": (
        instruct("smolvla", adapt_to_pi_aloha=True), "the 14 joints of ALOHA"),
    "ALOHA by text": (
        instruct("smolvla", adapt_to_pi_aloha="no"), "adapt_to_pi_aloha 'no'"),
    "joints of numbers": (relative(exclude_joints=[1]), "exclude_joints"),
    "one joint of text": (relative(action_names="gripper"), "action_names"),
    "unknown mode": (edited(*STEPS, 3, "config", "norm_map", "STATE", to="ZCA"), "ZCA"),
    "missing statistic": (edited(STATES, "observation.state.std", to=None), "would pass .* unchanged, silently"),
    "other key": (edited(STATES, "observation.state.mean", to=None), "has no 'observation.state.mean'"),
    "missing quantile": (quantiles, "'observation.state.q01'"),
    "wrong width": (edited(STATES, "observation.state.mean", to=[0.0, 1.0]), r"has the shape \[2\]"),
    "infinite": (edited(STATES, "observation.state.mean", to=[0.0, 1.0, np.inf]), "not finite"),
    "no file of statistics": (edited(STATES, to=None), "lacks the file of statistics"),
    "statistics elsewhere": (edited(*STEPS, 3, "state_file", to="../../etc/passwd"), "lacks the file of statistics"),
}  # fmt: skip


@pytest.mark.parametrize("kind", BROKEN)
def test_a_broken_checkpoint_is_named_with_its_place_and_nothing_runs(tmp_path: Path, kind: str, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(LEROBOT_PYTHON, sys.executable)
    edit, words = BROKEN[kind]
    files = parts()
    edit(files)
    with pytest.raises(SourceError, match=words) as caught:
        LerobotCheckpoint.of(str(write(tmp_path / "c", files))).describe()
    assert caught.value.fix
    assert not (tmp_path / "pwned").exists()


def test_what_claims_a_directory(tmp_path: Path) -> None:
    folder = write(tmp_path / "c", parts())
    assert LerobotCheckpoint.claims(str(folder)) is Claim.CERTAIN
    (folder / "config.json").write_text('{"model_type": "llama"}')
    assert LerobotCheckpoint.claims(str(folder)) is Claim.NONE
    (folder / "config.json").write_text("not JSON")
    assert LerobotCheckpoint.claims(str(folder)) is Claim.NONE
    assert LerobotCheckpoint.claims(str(tmp_path / "absent")) is Claim.NONE


@pytest.mark.parametrize(
    ("python", "words"),
    [("/absent/python", "which is not a program"), (sys.executable, "LeRobot cannot trace the policy")],
)
def test_a_python_without_lerobot_is_an_error_and_leaves_nothing(
    tmp_path: Path, python: str, words: str, monkeypatch
) -> None:
    monkeypatch.setenv(LEROBOT_PYTHON, python)
    monkeypatch.setenv("VLATOOL_CACHE", str(tmp_path / "cache"))
    with pytest.raises(SourceError, match=words):
        LerobotCheckpoint.of(str(write(tmp_path / "c", parts()))).describe()
    assert not list((tmp_path / "cache").rglob("policy.yaml"))


def test_without_lerobot_the_error_says_how_to_name_its_python(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.delenv(LEROBOT_PYTHON, raising=False)
    with pytest.raises(SourceError, match="not installed beside vlatool") as caught:
        LerobotCheckpoint.of(str(write(tmp_path / "c", parts()))).describe()
    assert "--python" in caught.value.fix


def test_a_python_without_lerobot_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(LEROBOT_PYTHON, sys.executable)
    with pytest.raises(SourceError, match="No module named") as caught:
        source_stage(str(write(tmp_path / "c", parts()))).describe()
    assert caught.value.fix.startswith("name the Python that LeRobot is installed in, with --python")
