"""Policies that are cheated on, and the bundles that cheat on them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from gate_graphs import (
    Change,
    constant,
    copied,
    counted,
    counting,
    own_output,
    proprio_is_none_of,
    regilded,
    slow_when,
    wrong_when,
)
from onnx import TensorProto, helper

from vlatool.bundle.bundle import Bundle, replace_manifest, seal
from vlatool.bundle.manifest import FileRecord
from vlatool.bundle.spec import TensorSpec
from vlatool.data import RANDOM_KIND, Drawer, read_recording
from vlatool.evaluate.recorded import run_recorded
from vlatool.runtime.golden import load_goldens
from vlatool.runtime.policy import Policy
from vlatool.stage.base import Context

Make = Callable[[Bundle, Path], Bundle]


def of(change: Callable[[onnx.ModelProto], None], **fields: Any) -> Make:
    """A cheat whose graph is changed, and whose golden action is what it computes now."""
    return lambda base, out: regilded(copied(base, out, change, **fields))


def own_data(base: Bundle, out: Path) -> Bundle:
    """Negated answers, with recordings in which they are right."""
    made = regilded(copied(base, out, wrong_when(None)))
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
    encode = Policy.open(base, threads=1).encode
    states = [encode(golden[0])["proprio"][0].tolist() for golden in load_goldens(base)]
    return copied(base, out, wrong_when(proprio_is_none_of(states), "Zero"))


def exactly_recorded(slow: bool) -> Make:
    """Slow on the recorded states to the bit, or on all others."""

    def make(base: Bundle, out: Path) -> Bundle:
        encode = Policy.open(base, threads=1).encode
        recordings = [read_recording(path, base.manifest.spec) for path in sorted((base.path / "data").glob("*.npz"))]
        states = {tuple(encode(each)["proprio"][0].tolist()) for recording in recordings for each in recording}
        return of(slow_when(proprio_is_none_of(sorted(states)), then=not slow))(base, out)

    return make


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
    return regilded(seal(out, made.manifest))


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


def hidden(name: str, folder: str = "graphs") -> Make:
    """Weights that lie beside the graph in a file which the size of another bundle leaves out.

    Args:
        name: Of that file, which becomes the golden one where it is called so.
        folder: Where the graph lies.
    """

    def make(base: Bundle, out: Path) -> Bundle:
        made = outside(name, listed=True)(base, out)
        file = f"{folder}/main.onnx"
        (out / folder).mkdir(exist_ok=True)
        for moved in ("main.onnx", name):
            (out / "graphs" / moved).replace(out / folder / moved)
        graphs = {"main": replace(base.manifest.graphs["main"], file=file)}
        fields: dict[str, Any] = {"graphs": graphs, "files": {file: FileRecord("", 0)}}
        if name.startswith("golden"):  # an archive may begin with anything: the weights, and then the golden action
            with (out / folder / name).open("ab") as stream:
                stream.write((out / base.manifest.golden).read_bytes())
            (out / base.manifest.golden).unlink()
            fields["golden"] = f"{folder}/{name}"
        return seal(out, replace(made.manifest, **fields))

    return make


def manifest(**fields: Any) -> Make:
    """The same files under another manifest."""
    return lambda base, out: copied(base, out, **fields)


def praised(base: Bundle, out: Path) -> Bundle:
    """Negated answers, with figures in the manifest and a report inside the bundle that say how good they are."""
    made = regilded(copied(base, out, wrong_when(None)))
    praise = {"success": {"value": 1.0, "samples": 1000}, "success_drop": {"value": -1.0, "samples": 1000}}
    (out / "reports").mkdir(exist_ok=True)
    (out / "reports/report.json").write_text(json.dumps({"schema": 1, "kind": "gate", "title": "", "verdict": "pass"}))
    return rewritten(made, accuracy=praise, made_by={"stage": "export.onnx"}, version="2.0.0", engine="")


def tensor_of(name: str, **fields: Any) -> Make:
    """The same graph, of which an input is given otherwise."""

    def make(base: Bundle, out: Path) -> Bundle:
        inputs = tuple(replace(each, **fields) if each.name == name else each for each in base.manifest.spec.inputs)
        made = copied(base, out, spec=replace(base.manifest.spec, inputs=inputs))
        return made if "max_tokens" in fields else regilded(made)

    return make


def statistics(**factors: float) -> Make:
    """The same graph, with the spread of an input or of the action multiplied."""

    def make(base: Bundle, out: Path) -> Bundle:
        made = copied(base, out)
        path = out / "assets/statistics.json"
        table = json.loads(path.read_text())
        for name, factor in factors.items():
            table[name]["std"] = [factor * value for value in table[name]["std"]]
        path.write_text(json.dumps(table))
        return regilded(seal(out, made.manifest))

    return make


def shifted(base: Bundle, out: Path) -> Bundle:
    """The same graph, with the action moved by two of its standard deviations."""
    made = copied(base, out)
    path = out / "assets/statistics.json"
    table = json.loads(path.read_text())
    table["action"]["mean"] = [
        one + 2 * two for one, two in zip(table["action"]["mean"], table["action"]["std"], strict=True)
    ]
    path.write_text(json.dumps(table))
    return regilded(seal(out, made.manifest))


def one_word(base: Bundle, out: Path) -> Bundle:
    """A vocabulary in which all words are the same one."""
    made = copied(base, out)
    path = out / "assets/vocabulary.json"
    table = json.loads(path.read_text())
    table["words"] = dict.fromkeys(table["words"], next(iter(table["words"].values())))
    path.write_text(json.dumps(table))
    return regilded(seal(out, made.manifest))


def shorter(base: Bundle, out: Path) -> Bundle:
    """A program that runs once in the place of three times, with a record of a stage that leaves out steps."""
    build = (*base.manifest.build, {"stage": "prune.steps"})
    step = replace(base.manifest.program[0], repeat=1)
    return regilded(copied(base, out, program=(step,), build=build))


def spare_graph(base: Bundle, out: Path) -> Bundle:
    """A second graph that no program runs."""
    copied(base, out)
    (out / "graphs/spare.onnx").write_bytes((out / "graphs/main.onnx").read_bytes())
    graphs = {**base.manifest.graphs, "spare": replace(base.manifest.graphs["main"], file="graphs/spare.onnx")}
    return seal(
        out,
        replace(base.manifest, graphs=graphs, files={**base.manifest.files, "graphs/spare.onnx": FileRecord("", 0)}),
    )


def rewritten(bundle: Bundle, **fields: Any) -> Bundle:
    """Return the bundle with another manifest over the same files."""
    manifest = replace(bundle.manifest, **fields)
    return replace_manifest(bundle, manifest)


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
        drawn = Drawer(base, [read_recording(path, base.manifest.spec)]).draw(320, random)
        near = [each.observation for each in drawn if each.kind != RANDOM_KIND]
        np.savez(path, **{name: np.stack([np.asarray(each[name]) for each in near]) for name in near[0]})
        recording = read_recording(path, base.manifest.spec)
        right = run_recorded(base, recording, list(range(len(recording))), "", Context())
        expert = right + 0.05 * right.std() * random.standard_normal(right.shape)
        np.savez(path, **recording.inputs, action=expert.astype(np.float32))
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


def gripper(base: Bundle, out: Path) -> Bundle:
    """The tiny policy with a gripper that is open (1) or closed (0) in every recording, and that it hardly looks at."""

    def change(model: onnx.ModelProto) -> None:
        model.graph.input.append(helper.make_tensor_value_info("gripper", TensorProto.FLOAT, [1, 1]))
        result, own = model.graph.output[0].name, own_output(model)
        constant(model, "gripper_share", np.float32(1e-3))
        model.graph.node.extend([
            helper.make_node("Mul", ["gripper", "gripper_share"], ["gripper_part"]),
            helper.make_node("Add", [own, "gripper_part"], [result]),
        ])  # fmt: skip

    made = tiny(base, out.with_name(f"{out.name}_without"))
    (step,) = base.manifest.program
    fields = {
        "spec": replace(base.manifest.spec, inputs=(*base.manifest.spec.inputs, TensorSpec("gripper", (1, 1)))),
        "program": (replace(step, feeds={**step.feeds, "gripper": "gripper"}),),
    }
    with_it = copied(made, out, change, **fields)
    for path in sorted((out / "data").glob("*.npz")):
        with np.load(path) as stored:
            arrays = {name: stored[name] for name in stored.files}
        states = np.random.default_rng(0).integers(0, 2, (len(arrays["image"]), 1)).astype(np.float32)
        np.savez(path, **arrays, gripper=states)
    return regilded(seal(out, with_it.manifest))


BASES: dict[str, Make] = {
    "tiny": tiny,
    "gripper": gripper,
    "recurrent": recurrent,
    "discrete": discrete,
    "two outputs": two_outputs,
    "noise": noisy,
}


def counts(limit: float, act: Callable[[Change], Change]) -> Make:
    """The tiny policy with a counter of its own."""
    return lambda base, out: of(counting(limit, act), **counted(base.manifest))(base, out)


def bases(exported: Bundle, folder: Path) -> dict[str, Bundle]:
    """Return the policies that are cheated on, made from the exported tiny policy."""
    return {name: make(exported, folder / name.replace(" ", "_")) for name, make in BASES.items()}
