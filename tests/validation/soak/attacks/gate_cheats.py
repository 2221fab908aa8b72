"""Bundles that cheat on the gate, each held against the policy that it was made from, on the real command line.

    python tests/validation/soak/attacks/gate_cheats.py                # every cheat: its exit code and why
    python tests/validation/soak/attacks/gate_cheats.py --only text    # those whose name contains a word

Every cheat must leave with 1 (fail) because of the claim that is meant to find it, or with 3 (refused), and the honest
candidates at the end with 0; the command leaves with 1 otherwise. Policies: ``tiny`` of the tests, and versions of it
with a gripper, with discrete actions, with two outputs, with noise and denoising steps, and with values that it keeps.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

from gate_bundles import (
    Make,
    bases,
    compute,
    counts,
    engine,
    exactly_recorded,
    golden_alone,
    golden_of_another,
    hidden,
    manifest,
    negated_second,
    of,
    one_word,
    other_statistics,
    other_words,
    outside,
    own_data,
    perturbed,
    praised,
    program,
    remembered_count,
    remembering,
    resized,
    shifted,
    shorter,
    spare_graph,
    spec,
    statistics,
    swapped,
    swept,
    tensor_of,
    without_golden,
)
from gate_graphs import (
    above,
    any_structure,
    any_text,
    drawn_later,
    large_when,
    slow_when,
    text_is_none_of,
    whole,
    wrong_when,
)

from vlatool.bundle.bundle import Bundle
from vlatool.stage.base import Context

RECORDED_TEXTS = ((2, 3, 4, 7), (2, 3, 4, 8), (5, 7, 0, 0), (6, 8, 0, 0))
FAST = {"latency": None}
"""A gate that times nothing: enough for what is wrong, not slow."""
PLAYED = {"latency": None, "accuracy": {"episodes": 4}}
TIMED = {"latency": {"interim_analyses": [10], "pairs": 60, "margin": 0.25, "warmup": 5}, "size": None}
"""A gate with a margin above what a busy machine and a policy of 50 us make of two equal bundles."""


@dataclass(frozen=True)
class Cheat:
    """What is cheated on, how, under which gate, and which claim must find it (empty: it must be refused)."""

    policy: str
    make: Make
    gate: dict[str, Any]
    found_by: str = ""


NOISE_ZERO = {"latent": {"shape": [1, 4, 2], "distribution": "zeros"}}
CHEATS: dict[str, Cheat] = {
    "fast on the empty instruction": Cheat("tiny", of(slow_when(any_text)), TIMED, "latency"),
    "fast on images of one colour": Cheat("tiny", of(slow_when(any_structure)), TIMED, "latency"),
    "slow on a tenth of the states": Cheat("tiny", of(slow_when(above("proprio", 1.28))), TIMED, "latency"),
    "slow on rare states": Cheat("tiny", of(slow_when(above("proprio", 2.2))), TIMED, "latency"),
    "slow on texts that were not recorded": Cheat(
        "tiny", of(slow_when(text_is_none_of(RECORDED_TEXTS))), TIMED, "latency"
    ),
    "slow on states exactly as they were recorded": Cheat("tiny", exactly_recorded(slow=True), TIMED, "latency"),
    "slow on all states but those exactly as they were recorded": Cheat(
        "tiny", exactly_recorded(slow=False), TIMED, "latency"
    ),
    "slow on states with a gripper that is exactly open or closed": Cheat(
        "gripper", of(slow_when(whole("gripper"))), TIMED, "latency"
    ),
    "keeps a deadline on easy inputs": Cheat(
        "tiny", of(slow_when(above("proprio", 1.0))), {**FAST, "deadline": {"ms": 0.5, "percent": 95}}, "deadline"
    ),
    "slow after 200 inferences": Cheat("tiny", counts(200, slow_when), FAST),
    "slow until 20 inferences": Cheat("tiny", counts(20, lambda when: slow_when(when, then=False)), FAST),
    "garbage after 8 inferences": Cheat("tiny", counts(8, wrong_when), FAST),
    "garbage after 2000 inferences, counted by drawing": Cheat("tiny", of(wrong_when(drawn_later(2000))), FAST),
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
    "weights beside the graph, not listed": Cheat("tiny", outside("more.bin", listed=False), FAST),
    "weights among the assets": Cheat("tiny", outside("../assets/more.bin", listed=True), FAST),
    "weights among the reports, not listed": Cheat("tiny", outside("../reports/more.bin", listed=False), FAST),
    "weights in the golden file": Cheat("tiny", hidden("golden.npz"), FAST, "size"),
    "weights in what is called calibration": Cheat("tiny", hidden("calibration.npz", "data"), FAST, "size"),
    "weights in what is called evaluation": Cheat("tiny", hidden("evaluation.npz", "data"), FAST, "size"),
    "weights in a file that desktops leave behind": Cheat("tiny", outside(".DS_Store", listed=False), FAST),
    "weights in what is called a signature": Cheat("tiny", outside("../SIGNATURE", listed=False), FAST),
    "weights in a graph that nothing runs": Cheat("tiny", spare_graph, FAST, "size"),
    "lists the easy task alone": Cheat(
        "tiny", manifest(environment={"make": "environment.py:make", "tasks": ["reach"]}), PLAYED
    ),
    "names another environment": Cheat(
        "tiny", manifest(environment={"make": "easy.py:make", "tasks": ["reach", "push"]}), PLAYED
    ),
    "a golden action that may be any": Cheat("tiny", manifest(golden_tolerance=1e9), FAST),
    "a golden chunk that may be any": Cheat("tiny", manifest(golden_chunk_tolerance=1e9), FAST),
    "fewer words of an instruction": Cheat("tiny", tensor_of("instruction", max_tokens=2), FAST),
    "fewer steps under a forged record, no accuracy claim": Cheat("noise", shorter, {**FAST, "accuracy": None}),
    "negated, with praise of its own": Cheat("tiny", praised, {**FAST, "accuracy": None}, "answers"),
    "a state that is hardly seen": Cheat("tiny", statistics(proprio=1000.0), FAST, "accuracy"),
    "a state that is seen larger": Cheat("tiny", statistics(proprio=0.02), FAST, "accuracy"),
    "a state that is not normalised": Cheat(
        "tiny", tensor_of("proprio", normalisation="none", statistics=""), FAST, "accuracy"
    ),
    "all words are one": Cheat("tiny", one_word, FAST, "accuracy"),
    "actions that are moved": Cheat("tiny", shifted, FAST, "accuracy"),
    "actions that are too small": Cheat("tiny", statistics(action=0.1), FAST, "accuracy"),
    "actions that are too small, no accuracy claim": Cheat(
        "tiny", statistics(action=0.1), {**FAST, "accuracy": None}, "answers"
    ),
    "actions that are moved, no accuracy claim": Cheat("tiny", shifted, {**FAST, "accuracy": None}, "answers"),
    "noise of another distribution": Cheat(
        "noise", program(noise={"latent": {"shape": [1, 4, 2], "distribution": "uniform"}}), FAST
    ),
    "a rate that differs in the tenth digit": Cheat("tiny", spec(control_hz=10.000000001), FAST),
    "a label that looks the same": Cheat("tiny", spec(action_labels=("dx", "dу")), FAST),
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
        found[type(stage).__name__] = stage.run(base, out, Context()).bundle
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
                gate = {"latency": {"margin": 1.0, "worst": 2.0, "interim_analyses": [10], "pairs": 60},
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
        return done.returncode, failed(done.stdout) or "every claim is kept"
    except (ValueError, KeyError):
        lines = [line for line in done.stderr.splitlines() if line.startswith("error")]
        return done.returncode, (lines or ["?"])[-1]


def failed(report: str) -> str:
    """Return the claims of a document that fail, each with its sentence; the error where the gate judged nothing."""
    told = json.loads(report)
    if "rows" not in told:
        return f"error: {told['error']['message']}"
    claims = told["rows"][1]["details"]["claims"]
    return "; ".join(f"{each['claim']}: {each['found']}" for each in claims if each["verdict"] == "fail")


def exported(folder: Path) -> Bundle:
    """Return the tiny policy of the tests, exported."""
    sys.path.insert(0, str(Path(__file__).parents[3]))
    from _tiny import write_policy

    from vlatool.export.onnx import ExportOnnx
    from vlatool.sources.torch_module import TorchModule
    from vlatool.user_code import trust

    policy = folder / "policy"
    write_policy(policy)
    trust.allow(policy)
    for name in ("source", "exported"):
        (folder / name).mkdir()
    source = TorchModule(policy=policy).run(None, folder / "source", Context()).bundle
    return ExportOnnx().run(source, folder / "exported", Context()).bundle


if __name__ == "__main__":
    raise SystemExit(main())
