"""Bundles that cheat on the gate, each held against the policy that it was made from, on the real command line.

    python tests/soak/attacks/gate_cheats.py                # every cheat: its exit code and why
    python tests/soak/attacks/gate_cheats.py --only text    # those whose name contains a word

Every cheat must leave with 1 (fail) because of the claim that is meant to find it, or with 3 (refused), and the honest
candidates at the end with 0; the command leaves with 1 otherwise. Policies: ``tiny`` of the tests, and versions of it
with discrete actions, with two outputs, with noise and denoising steps, and with values that it keeps.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper

sys.path.insert(0, str(Path(__file__).parent))

from gate_graphs import (
    Change,
    above,
    any_structure,
    any_text,
    constant,
    copied,
    counted,
    counting,
    large_when,
    own_output,
    proprio_is_not,
    regilded,
    slow_when,
    text_is_none_of,
    wrong_when,
)

from vlatool.bundle import Bundle, manifest_bytes, seal
from vlatool.data import read_recording
from vlatool.evaluate.recorded import run_recorded
from vlatool.manifest import FileRecord
from vlatool.runtime.policy import load_golden
from vlatool.stage import Context

Make = Callable[[Bundle, Path], Bundle]
RECORDED_TEXTS = ((2, 3, 4, 7), (2, 3, 4, 8), (5, 7, 0, 0), (6, 8, 0, 0))
FAST = {"latency": None}
"""A gate that times nothing: enough for what is wrong, not slow."""
TIMED = {"latency": {"looks": [10], "pairs": 60, "margin": 0.25, "warmup": 5}, "size": None}
"""A gate with a margin above what a busy machine and a policy of 50 us make of two equal bundles."""


def of(change: Callable[[onnx.ModelProto], None], **fields: Any) -> Make:
    """A cheat whose graph is changed, and whose golden action is what it computes now."""
    return lambda base, out: regilded(copied(base, out, change, **fields))


def own_data(base: Bundle, out: Path) -> Bundle:
    """Negated answers, with recordings in which they are right."""
    made = copied(base, out, wrong_when(None))
    for name in ("calibration", "evaluation"):
        path = out / f"data/{name}.npz"
        recording = read_recording(path, base.manifest.spec)
        right = run_recorded(made, recording, list(range(len(recording))), "", Context())
        with np.load(path) as stored:
            arrays = {key: stored[key] for key in stored.files}
        np.savez(path, **{**arrays, "action": right[:, :1] if right.ndim == 2 else right})
    return regilded(made)


def golden_of_another(base: Bundle, out: Path) -> Bundle:
    """A golden action that this graph does not compute: ``load`` refuses it."""
    made = copied(base, out)
    with np.load(out / base.manifest.golden) as stored:
        arrays = {name: stored[name] for name in stored.files}
    name = f"out.{base.manifest.spec.action.name}"
    np.savez(out / base.manifest.golden, **{**arrays, name: -arrays[name]})
    return seal(out, made.manifest)


def golden_alone(base: Bundle, out: Path) -> Bundle:
    """Right for the golden states, zero everywhere else."""
    golden = load_golden(base)
    assert golden is not None
    from vlatool.runtime.policy import Policy

    state = Policy.open(base, threads=1).encode(golden[0])["proprio"][0].tolist()
    return copied(base, out, wrong_when(proprio_is_not(state), "Zero"))


def without_golden(base: Bundle, out: Path) -> Bundle:
    """Negated, with nothing that says what it should compute."""
    return copied(base, out, wrong_when(None), golden="")


def other_statistics(base: Bundle, out: Path) -> Bundle:
    """The same graph, un-normalised by three times the spread."""
    made = copied(base, out)
    path = out / "assets/statistics.json"
    table = json.loads(path.read_text())
    table["action"]["std"] = [3 * value for value in table["action"]["std"]]
    path.write_text(json.dumps(table))
    return seal(out, made.manifest)


def other_words(base: Bundle, out: Path) -> Bundle:
    """A vocabulary whose words mean each other."""
    made = copied(base, out)
    path = out / "assets/vocabulary.json"
    table = json.loads(path.read_text())
    words = list(table["words"])
    table["words"] = dict(zip(words, reversed(table["words"].values()), strict=True))
    path.write_text(json.dumps(table))
    return regilded(seal(out, made.manifest))


def perturbed(base: Bundle, out: Path) -> Bundle:
    """The baseline with other weights and repaired hashes."""

    def change(model: onnx.ModelProto) -> None:
        for tensor in model.graph.initializer:
            values = onnx.numpy_helper.to_array(tensor)
            if values.dtype == np.float32 and values.ndim == 2:
                noise = np.random.default_rng(0).normal(size=values.shape).astype(np.float32)
                tensor.CopyFrom(onnx.numpy_helper.from_array(values + 2 * values.std() * noise, tensor.name))

    return copied(base, out, change)


def outside(place: str, listed: bool, added: int = 4_000_000) -> Make:
    """Weights of ``added`` bytes more in a file beside or away from the graph, listed in the manifest or not."""

    def make(base: Bundle, out: Path) -> Bundle:
        def change(model: onnx.ModelProto) -> None:
            result, own = model.graph.output[0].name, own_output(model)
            tensor = TensorProto(name="more", data_type=TensorProto.FLOAT, dims=[added // 4])
            tensor.data_location = TensorProto.EXTERNAL
            for key, value in (("location", place), ("offset", "0"), ("length", str(added))):
                tensor.external_data.add(key=key, value=value)
            model.graph.initializer.append(tensor)
            constant(model, "more_tiny", np.float32(1e-30))
            model.graph.node.extend([
                helper.make_node("ReduceSum", ["more"], ["more_sum"], keepdims=0),
                helper.make_node("Mul", ["more_sum", "more_tiny"], ["more_nothing"]),
                helper.make_node("Add", [own, "more_nothing"], [result]),
            ])  # fmt: skip

        copied(base, out)
        graph = out / next(iter(base.manifest.graphs.values())).file
        weights = (graph.parent / place).resolve()
        weights.parent.mkdir(exist_ok=True, parents=True)
        np.zeros(added // 4, np.float32).tofile(weights)
        model = onnx.load(graph)
        change(model)
        graph.write_bytes(model.SerializeToString())
        made = seal(out, base.manifest)
        if listed:
            return made
        name = weights.relative_to(out.resolve()).as_posix()
        files = {path: record for path, record in made.manifest.files.items() if path != name}
        return rewritten(made, files=files)

    return make


def rewritten(bundle: Bundle, **fields: Any) -> Bundle:
    """Return the bundle with another manifest over the same files."""
    manifest = replace(bundle.manifest, **fields)
    (bundle.path / "manifest.json").write_bytes(manifest_bytes(manifest))
    return Bundle(bundle.path, manifest)


def resized(base: Bundle, out: Path) -> Bundle:
    """A manifest that gives a graph fewer bytes than it has."""
    made = outside("more.bin", listed=True)(base, out)
    files = {path: FileRecord(record.sha256, 10) for path, record in made.manifest.files.items() if "more" in path}
    return rewritten(made, files={**made.manifest.files, **files})


def spec(**fields: Any) -> Make:
    """The same graph under another spec; a field of the action begins with ``action_``."""

    def make(base: Bundle, out: Path) -> Bundle:
        own = {name: value for name, value in fields.items() if not name.startswith("action_")}
        action = {name[7:]: value for name, value in fields.items() if name.startswith("action_")}
        outputs = (replace(base.manifest.spec.action, **action), *base.manifest.spec.outputs[1:])
        return copied(base, out, spec=replace(base.manifest.spec, outputs=outputs, **own))

    return make


def swapped(base: Bundle, out: Path) -> Bundle:
    """Another output first: it is the action."""
    return copied(base, out, spec=replace(base.manifest.spec, outputs=base.manifest.spec.outputs[::-1]))


def program(**fields: Any) -> Make:
    """The same graph under another program."""
    return lambda base, out: regilded(copied(base, out, program=(replace(base.manifest.program[0], **fields),)))


def engine(name: str) -> Make:
    """The same graph for another engine."""
    return lambda base, out: copied(base, out, engine=name)


def compute(dtype: str) -> Make:
    """The same graph, computed in another dtype."""

    def make(base: Bundle, out: Path) -> Bundle:
        graphs = {name: replace(graph, compute=dtype) for name, graph in base.manifest.graphs.items()}
        return copied(base, out, graphs=graphs)

    return make


def negated_second(model: onnx.ModelProto) -> None:
    """Negate the second output."""
    result = model.graph.output[1].name
    node = next(each for each in model.graph.node if result in each.output)
    node.output[list(node.output).index(result)] = "own_second"
    model.graph.node.append(helper.make_node("Neg", ["own_second"], [result]))


def remembering(base: Bundle, out: Path) -> Bundle:
    """Answers a state that it saw in the last inference from what it kept, and is slow otherwise."""

    def change(model: onnx.ModelProto) -> None:
        for name in ("last", "last_next"):
            info = helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, 3])
            (model.graph.input if name == "last" else model.graph.output).append(info)
        constant(model, "cond_near", np.float32(1e-6))
        model.graph.node.extend([
            helper.make_node("Identity", ["proprio"], ["last_next"]),
            helper.make_node("Sub", ["proprio", "last"], ["cond_off"]),
            helper.make_node("Abs", ["cond_off"], ["cond_abs"]),
            helper.make_node("ReduceMax", ["cond_abs"], ["cond_worst"], keepdims=0),
            helper.make_node("Greater", ["cond_worst", "cond_near"], ["cond"]),
        ])  # fmt: skip

    (step,) = base.manifest.program
    feeds, gives = {**step.feeds, "last": "last"}, {**step.gives, "last_next": "last"}
    kept = replace(step, feeds=feeds, gives=gives, keep={"last": {"shape": [1, 3]}})
    return regilded(copied(base, out, slow_when(change), program=(kept,)))


def swept(base: Bundle, out: Path) -> Bundle:
    """A file that changes after its hash was taken."""
    made = copied(base, out)
    (out / "assets/statistics.json").write_text("{}")
    return made


def tiny(base: Bundle, out: Path) -> Bundle:
    """The tiny policy, with recordings of an expert that it follows."""
    made = copied(base, out)
    random = np.random.default_rng(0)
    for path in sorted((out / "data").glob("*.npz")):
        recording = read_recording(path, base.manifest.spec)
        right = run_recorded(base, recording, list(range(len(recording))), "", Context())
        with np.load(path) as stored:
            arrays = {name: stored[name] for name in stored.files}
        expert = right + 0.2 * right.std() * random.standard_normal(right.shape)
        np.savez(path, **{**arrays, "action": expert.astype(np.float32)})
    return seal(out, made.manifest)


def recurrent(base: Bundle, out: Path) -> Bundle:
    """The tiny policy with a value that it keeps and hardly uses: room for a counter."""

    def change(model: onnx.ModelProto) -> None:
        model.graph.input.append(helper.make_tensor_value_info("memory", TensorProto.FLOAT, [1, 2]))
        model.graph.output.append(helper.make_tensor_value_info("memory_next", TensorProto.FLOAT, [1, 2]))
        result, own = model.graph.output[0].name, own_output(model)
        constant(model, "memory_step", np.array([[0.1, 0.0]], np.float32))
        constant(model, "memory_share", np.float32(1e-3))
        model.graph.node.extend([
            helper.make_node("Add", ["memory", "memory_step"], ["memory_next"]),
            helper.make_node("Mul", ["memory", "memory_share"], ["memory_part"]),
            helper.make_node("Add", [own, "memory_part"], [result]),
        ])  # fmt: skip

    (step,) = base.manifest.program
    feeds, gives = {**step.feeds, "memory": "memory"}, {**step.gives, "memory_next": "memory"}
    kept = replace(step, feeds=feeds, gives=gives, keep={"memory": {"shape": [1, 2]}})
    return regilded(copied(base, out, change, program=(kept,)))


def remembered_count(limit: float) -> Change:
    """A condition: the value that the recurrent policy keeps has counted beyond a limit."""

    def add(model: onnx.ModelProto) -> None:
        constant(model, "cond_limit", np.float32(limit))
        model.graph.node.extend([
            helper.make_node("ReduceMax", ["memory"], ["cond_scalar"], keepdims=0),
            helper.make_node("Greater", ["cond_scalar", "cond_limit"], ["cond"]),
        ])  # fmt: skip

    return add


def discrete(base: Bundle, out: Path) -> Bundle:
    """The tiny policy with its actions as logits over two labels, and recordings of what it chooses."""
    action = replace(base.manifest.spec.action, kind="discrete", labels=("left", "right"), unit="", mode="",
                     normalisation="none", statistics="")  # fmt: skip
    made = copied(base, out, spec=replace(base.manifest.spec, outputs=(action,)))
    for path in sorted((out / "data").glob("*.npz")):
        with np.load(path) as stored:
            arrays = {name: stored[name] for name in stored.files if name != "action"}
        np.savez(path, **arrays)
        recording = read_recording(path, made.manifest.spec)
        chosen = run_recorded(made, recording, list(range(len(recording))), "", Context())
        np.savez(path, **arrays, action=chosen)
    return regilded(seal(out, made.manifest))


def two_outputs(base: Bundle, out: Path) -> Bundle:
    """The tiny policy with its mean action as a second output."""
    from vlatool.spec import TensorSpec

    def change(model: onnx.ModelProto) -> None:
        model.graph.output.append(helper.make_tensor_value_info("value", TensorProto.FLOAT, [1, 4, 2]))
        constant(model, "value_one", np.float32(1))
        model.graph.node.append(helper.make_node("Add", [model.graph.output[0].name, "value_one"], ["value"]))

    (step,) = base.manifest.program
    outputs = (*base.manifest.spec.outputs, TensorSpec("value", (1, 4, 2)))
    fields = {
        "spec": replace(base.manifest.spec, outputs=outputs),
        "program": (replace(step, gives={**step.gives, "value": "value"}),),
    }
    return regilded(copied(base, out, change, **fields))


def noisy(base: Bundle, out: Path) -> Bundle:
    """The tiny policy with noise that three steps turn into an action."""

    def change(model: onnx.ModelProto) -> None:
        model.graph.input.append(helper.make_tensor_value_info("latent", TensorProto.FLOAT, [1, 4, 2]))
        result, own = model.graph.output[0].name, own_output(model)
        constant(model, "latent_half", np.float32(0.5))
        model.graph.node.extend([
            helper.make_node("Mul", ["latent", "latent_half"], ["latent_part"]),
            helper.make_node("Add", [own, "latent_part"], [result]),
        ])  # fmt: skip

    (step,) = base.manifest.program
    step = replace(step, feeds={**step.feeds, "latent": "latent"}, noise={"latent": {"shape": [1, 4, 2]}}, repeat=3,
                   carry={step.gives[next(iter(step.gives))]: "latent"})  # fmt: skip
    return regilded(copied(base, out, change, program=(step,)))


BASES: dict[str, Make] = {
    "tiny": tiny,
    "recurrent": recurrent,
    "discrete": discrete,
    "two outputs": two_outputs,
    "noise": noisy,
}


@dataclass(frozen=True)
class Cheat:
    """What is cheated on, how, under which gate, and which claim must find it (empty: it must be refused)."""

    policy: str
    make: Make
    gate: dict[str, Any]
    found_by: str = ""


def counts(limit: float, act: Callable[[Change], Change]) -> Make:
    """The tiny policy with a counter of its own."""
    return lambda base, out: of(counting(limit, act), **counted(base.manifest))(base, out)


NOISE_ZERO = {"latent": {"shape": [1, 4, 2], "distribution": "zeros"}}
CHEATS: dict[str, Cheat] = {
    "fast on the empty instruction": Cheat("tiny", of(slow_when(any_text)), TIMED, "latency"),
    "fast on images of one colour": Cheat("tiny", of(slow_when(any_structure)), TIMED, "latency"),
    "slow on a tenth of the states": Cheat("tiny", of(slow_when(above("proprio", 1.28))), TIMED, "latency"),
    "slow on rare states": Cheat("tiny", of(slow_when(above("proprio", 2.2))), TIMED, "latency"),
    "slow on texts that were not recorded": Cheat(
        "tiny", of(slow_when(text_is_none_of(RECORDED_TEXTS))), TIMED, "latency"
    ),
    "keeps a deadline on easy inputs": Cheat(
        "tiny", of(slow_when(above("proprio", 1.0))), {**FAST, "deadline": {"ms": 0.5, "percent": 95}}, "deadline"
    ),
    "slow after 200 inferences": Cheat("tiny", counts(200, slow_when), FAST),
    "slow until 20 inferences": Cheat("tiny", counts(20, lambda when: slow_when(when, then=False)), FAST),
    "garbage after 8 inferences": Cheat("tiny", counts(8, wrong_when), FAST),
    "slow after 10 inferences, in a value that is kept anyway": Cheat(
        "recurrent", of(slow_when(remembered_count(0.95))), TIMED, "latency"
    ),
    "garbage after 10 inferences, in a value that is kept anyway": Cheat(
        "recurrent", of(wrong_when(remembered_count(0.95))), FAST, "answers"
    ),
    "remembers the last input": Cheat("tiny", remembering, TIMED),
    "more memory on any text": Cheat("tiny", of(large_when(any_text)), FAST, "memory"),
    "more memory after 30 inferences": Cheat("tiny", counts(30, large_when), FAST),
    "negated, with data of its own": Cheat("tiny", own_data, {**FAST, "answers": None}, "accuracy"),
    "negated logits, with data of its own": Cheat("discrete", own_data, {**FAST, "answers": None}, "accuracy"),
    "negated logits, no accuracy claim": Cheat("discrete", of(wrong_when(None)), {**FAST, "accuracy": None}, "answers"),
    "golden action that load refuses": Cheat("tiny", golden_of_another, FAST),
    "golden action alone is right": Cheat("tiny", golden_alone, FAST, "answers"),
    "no golden action": Cheat("tiny", without_golden, FAST),
    "other statistics": Cheat("tiny", other_statistics, FAST, "accuracy"),
    "words that mean each other": Cheat("tiny", other_words, FAST, "accuracy"),
    "other weights, repaired hashes": Cheat("tiny", perturbed, FAST),
    "garbage on texts that were not recorded": Cheat(
        "tiny", of(wrong_when(text_is_none_of(RECORDED_TEXTS))), FAST, "answers"
    ),
    "NaN on rare states": Cheat("tiny", of(wrong_when(above("proprio", 2.5), "NaN")), FAST),
    "the second output is wrong": Cheat("two outputs", of(negated_second), FAST, "answers"),
    "the second output first": Cheat("two outputs", swapped, FAST),
    "weights beside the graph": Cheat("tiny", outside("more.bin", listed=True), FAST, "size"),
    "weights beside the graph, not listed": Cheat("tiny", outside("more.bin", listed=False), FAST, "size"),
    "weights among the assets": Cheat("tiny", outside("../assets/more.bin", listed=True), FAST),
    "weights among the reports, not listed": Cheat("tiny", outside("../reports/more.bin", listed=False), FAST),
    "weights with other sizes in the manifest": Cheat("tiny", resized, FAST),
    "a file that was changed": Cheat("tiny", swept, FAST),
    "another rate": Cheat("tiny", spec(control_hz=5), FAST),
    "another chunk": Cheat("tiny", spec(chunk=2), FAST),
    "more of a chunk executed": Cheat("tiny", spec(execute=4), FAST),
    "another unit": Cheat("tiny", spec(action_unit=("mm", "mm")), FAST),
    "another mode": Cheat("tiny", spec(action_mode="absolute"), FAST),
    "labels swapped": Cheat("tiny", spec(action_labels=("dy", "dx")), FAST),
    "labels of logits swapped": Cheat("discrete", spec(action_labels=("right", "left")), FAST),
    "fewer denoising steps": Cheat("noise", program(repeat=1), FAST),
    "zeros for noise": Cheat("noise", program(noise=NOISE_ZERO), FAST),
    "an engine that does not exist": Cheat("tiny", engine("ort_cpu_fast"), FAST),
    "a dtype that the engine lacks": Cheat("tiny", compute("bfloat16"), FAST),
}


def bases(exported: Bundle, folder: Path) -> dict[str, Bundle]:
    """Return the policies that are cheated on, made from the exported tiny policy."""
    return {name: make(exported, folder / name.replace(" ", "_")) for name, make in BASES.items()}


def gate_file(gate: dict[str, Any], path: Path) -> Path:
    """Write a gate file (JSON is YAML), with more room for memory than a busy machine takes."""
    path.write_text(json.dumps({"memory": {"margin": 0.5}, **gate}))
    return path


def honest(base: Bundle, folder: Path) -> dict[str, Bundle]:
    """Return candidates that do not cheat: the same bundle, and static and dynamic int8."""
    from vlatool.quantize.dynamic_int8 import DynamicInt8
    from vlatool.quantize.static_int8 import StaticInt8

    found = {"the same bundle": base}
    for stage in (StaticInt8(), DynamicInt8()):
        out = folder / type(stage).__name__
        out.mkdir()
        found[type(stage).__name__] = stage.run(base, out, Context())
    return found


def main() -> int:
    """Try every cheat and print what became of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="cheats whose name contains this")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        known = bases(exported(folder), folder)
        wrong = 0
        for title, cheat in CHEATS.items():
            if given.only in title:
                out = folder / "candidate"
                shutil.rmtree(out, ignore_errors=True)
                cheat.make(known[cheat.policy], out)
                outcome = run(out, known[cheat.policy].path, gate_file(cheat.gate, folder / "gate.yaml"))
                wrong += told(title, *outcome, 1 if cheat.found_by else 3, cheat.found_by)
        for title, bundle in honest(known["tiny"], folder).items():
            if given.only in title:
                gate = {"latency": {"margin": 1.0, "worst": 2.0, "looks": [10], "pairs": 60},
                        "accuracy": {"max_drop": 0.5}, "size": {"margin": 1.0}}  # fmt: skip
                wrong += told(title, *run(bundle.path, known["tiny"].path, gate_file(gate, folder / "gate.yaml")), 0)
        print(f"{wrong} otherwise than they must")
    return int(wrong > 0)


def told(title: str, code: int, why: str, wanted: int, claim: str = "") -> int:
    """Print an outcome; return 1 when it is another one, or another claim found it."""
    fine = code == wanted and claim in why
    print(f"{'ok ' if fine else 'NOT'} {code} {title}: {why}", flush=True)
    return int(not fine)


def run(candidate: Path, baseline: Path, config: Path) -> tuple[int, str]:
    """Return the exit code of the command line, and the line that says why."""
    command = [sys.executable, "-m", "vlatool", "gate", str(candidate), "--baseline", str(baseline),
               "--config", str(config), "--json"]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=False, env={**os.environ, "COLUMNS": "200"})
    try:
        claims = json.loads(done.stdout)["rows"][1]["details"]["claims"]
        failed = [f"{each['claim']}: {each['found']}" for each in claims if each["verdict"] == "fail"]
        return done.returncode, "; ".join(failed) or "every claim is kept"
    except (ValueError, KeyError):
        lines = [line for line in done.stderr.splitlines() if line.startswith("error")]
        return done.returncode, (lines or ["?"])[-1]


def exported(folder: Path) -> Bundle:
    """Return the tiny policy of the tests, exported."""
    sys.path.insert(0, str(Path(__file__).parents[2]))
    import conftest

    from vlatool.export.onnx import ExportOnnx
    from vlatool.sources.torch_module import TorchModule

    policy = folder / "policy"
    conftest.write_policy(policy)
    for name in ("source", "exported"):
        (folder / name).mkdir()
    source = TorchModule(policy=policy).run(None, folder / "source", Context())
    return ExportOnnx().run(source, folder / "exported", Context())


if __name__ == "__main__":
    raise SystemExit(main())
