"""Judge policies, recordings, worlds and candidates that are broken on purpose, and honest ones beside them.

    python tests/validation/soak/attacks/broken_policies.py              # all; exit 1 when one is judged wrongly
    python tests/validation/soak/attacks/broken_policies.py swapped nan  # those whose name holds a word
    python tests/validation/soak/attacks/broken_policies.py --whole      # each through all of ``optimize``, slowly

Every case is the toy robot with one thing broken. It goes through export, int8, recorded observations, paired episodes
and the judgement of ``optimize``, and through the accuracy claim of a gate. Latencies are given (int8 twice as fast),
unless the whole pipeline runs. A broken case must not end with ``pass``; an honest one must.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import io
import json
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from broken_cases import CASES, WRAPPER, Case
from onnx import numpy_helper
from toy_robot import write_robot

from vlatool.bundle.bundle import Bundle, seal
from vlatool.cli import main as vlatool
from vlatool.cli._run import with_graphs
from vlatool.errors import VlatoolError
from vlatool.gate.claims.accuracy import Accuracy
from vlatool.gate.config import Gate
from vlatool.gate.run import run_gate
from vlatool.optimize.decision import decide
from vlatool.optimize.evidence import with_episodes, with_recordings
from vlatool.optimize.plan import make_plan
from vlatool.optimize.recipe import Effort, Limits, Recipe
from vlatool.quantize.dynamic_int8 import DynamicInt8
from vlatool.report import Measurement, Row
from vlatool.runtime.golden import load_goldens
from vlatool.sources import source_bundle, source_stage
from vlatool.stage.base import Context
from vlatool.stage.finish import write_golden

EPISODES = 20
DROP = 0.05


def write(case: Case, folder: Path) -> Path:
    """Write the folder of a case."""
    write_robot(folder, case.discrete)
    if case.forward:
        text = WRAPPER.format(build=case.build, forward=case.forward)
        (folder / "policy.py").write_text((folder / "policy.py").read_text() + text)
    (folder / "policy.py").write_text((folder / "policy.py").read_text() + case.policy)
    for old, new in case.world:
        text = (folder / "environment.py").read_text()
        assert old in text, f"{case.name}: the world has no {old}"
        (folder / "environment.py").write_text(text.replace(old, new))
    for name, change in (
        ("statistics", case.statistics),
        ("vocabulary", case.vocabulary and {"words": case.vocabulary}),
    ):
        known = json.loads((folder / f"{name}.json").read_text())
        words = {"words": known["words"] | (case.vocabulary or {})} if name == "vocabulary" and change else change
        (folder / f"{name}.json").write_text(json.dumps(known | (words or {})))
    for name in ("calibration", "evaluation") if case.recorded else ():
        with np.load(folder / f"{name}.npz") as stored:
            np.savez(folder / f"{name}.npz", **case.recorded({key: stored[key] for key in stored.files}))
    text = (folder / "policy.yaml").read_text()
    if case.evidence == "recordings":
        text = "".join(line for line in text.splitlines(True) if not line.startswith("environment"))
    (folder / "policy.yaml").write_text(text + case.program)
    if case.evidence == "world":
        (folder / "evaluation.npz").unlink()
    return folder


def bundles(case: Case, folder: Path, kept: Path) -> dict[str, Bundle]:
    """Make the float32 bundle of a case and its candidate.

    Args:
        case: What is broken.
        folder: Of the robot.
        kept: Where bundles are kept: cases that differ in recordings and worlds alone share an export.
    """
    code = "".join(
        (folder / name).read_text() for name in ("policy.py", "policy.yaml", "statistics.json", "vocabulary.json")
    )
    place = kept / hashlib.sha256(code.encode()).hexdigest()[:16]
    if not place.exists():
        source = source_bundle(source_stage(str(folder)), place / "cache", Context())
        baseline = with_graphs(source, place / "cache", Context()).bundle
        (place / "int8").mkdir()
        DynamicInt8().run(baseline, place / "int8", Context())
        shutil.copytree(baseline.path, place / "float32")
    return {name: _own(case, folder, place / name) for name in ("float32", "int8")}


def _own(case: Case, folder: Path, shared: Path) -> Bundle:
    """Copy a shared bundle and give it the recordings of the case, and its damage to the candidate."""
    candidate = Bundle.open(Path(shutil.copytree(shared, folder.parent / shared.name)))
    for name in ("calibration.npz", "evaluation.npz"):
        (candidate.path / "data" / name).unlink(missing_ok=True)
        if (folder / name).exists():
            shutil.copyfile(folder / name, candidate.path / "data" / name)
    candidate = seal(candidate.path, candidate.manifest)
    if case.candidate and shared.name == "int8":
        path = candidate.path / "graphs/main.onnx"
        model = onnx.load(path)
        for tensor in model.graph.initializer:
            tensor.CopyFrom(
                numpy_helper.from_array(case.candidate(tensor.name, numpy_helper.to_array(tensor)), tensor.name)
            )
        onnx.save(model, path)
        candidate = seal(candidate.path, candidate.manifest)
        write_golden(candidate, [golden[0] for golden in load_goldens(candidate)], candidate.path)  # a stage would
        candidate = seal(candidate.path, candidate.manifest)
    return candidate


def timed(name: str, ms: float) -> Row:
    """A row with a latency that is given."""
    speedup = Measurement("speedup", 10 / ms, "x", samples=20, low=9.9 / ms, high=10.1 / ms)
    measured = (Measurement("latency_p50", ms, "ms", samples=20), speedup, Measurement("size", 1.0, "MB"))
    return Row(name, "baseline" if name == "float32" else "subject", measurements=measured)


def by_optimize(case: Case, folder: Path, made: dict[str, Bundle], cache: Path) -> tuple[str, str]:
    """Judge as ``optimize`` does, with latencies that are given."""
    recipe = Recipe(
        candidates={"int8": ({"quantize.dynamic_int8": {}},)}, limits=Limits(max_drop=DROP),
        effort=Effort(episodes=EPISODES),
    )  # fmt: skip
    plan = make_plan(str(folder), None, recipe, cache)
    rows = {"float32": timed("float32", 10.0), "int8": timed("int8", 5.0)}
    loop, context = plan.closed_loop, Context()
    rows, _ = with_recordings(rows, made, loop, cache, context)
    decision = decide(plan, with_episodes(rows, made, loop, cache, context) if loop else rows)
    chosen, verdict, trust = decision.choice, decision.verdict, decision.trust
    if case.candidate and verdict == "pass" and chosen.row.name == "float32":
        return "fail", chosen.row.reason
    return verdict, " ".join((*trust.sentences[:1], *(chosen.sentences if not trust.fails else ())))


def by_gate(case: Case, folder: Path, made: dict[str, Bundle]) -> tuple[str, str]:
    """Hold the candidate against float32 as a gate does, by accuracy alone."""
    world = case.evidence != "recordings"
    claim = Accuracy(max_drop=0.3, episodes=EPISODES if world else 0, policy=folder if world else None)
    gate = Gate(latency=None, memory=None, size=None, accuracy=claim)
    report = run_gate(made["int8"], made["float32"], gate, Context())
    return report.verdict, report.summary[-1]


def by_command(folder: Path, cache: Path) -> tuple[str, str]:
    """Run the whole of ``vlatool optimize``."""
    (folder / "recipe.yaml").write_text("candidates: {int8: [quantize.dynamic_int8: {}]}")
    line = ["optimize", folder, "-o", folder.parent / "out", "--cache", cache, "--recipe", folder / "recipe.yaml",
            "--max-drop", DROP, "--episodes", EPISODES, "--iterations", 40, "--workers", 1, "--json"]  # fmt: skip
    said = io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(said):
        try:
            vlatool([str(part) for part in line])
            code: Any = 0
        except SystemExit as left:
            code = left.code or 0
    words = {0: "pass", 1: "fail", 5: "inconclusive"}.get(code, f"error {code}")
    return words, next((text for text in said.getvalue().splitlines() if text.startswith("error")), "")


def judge_case(case: Case, place: Path, kept: Path, whole: bool = False) -> dict[str, tuple[str, str]]:
    """Return way -> (verdict, why) of a case: ``pass``, ``fail``, ``inconclusive``, or ``error N``."""
    folder, cache = write(case, place / "robot"), place / "cache"
    if whole and not case.candidate:
        return {"optimize": by_command(folder, cache)}
    try:
        made = bundles(case, folder, kept)
    except VlatoolError as error:
        return {"export": (f"error {error.exit_code}", error.message)}
    found = {}
    for way, ask in (("optimize", lambda: by_optimize(case, folder, made, cache)),
                     ("gate", lambda: by_gate(case, folder, made))):  # fmt: skip
        try:
            found[way] = ask()
        except VlatoolError as error:
            found[way] = (f"error {error.exit_code}", error.message)
    return found


def rightly(case: Case, found: dict[str, tuple[str, str]]) -> bool:
    """Say whether a case was judged as it should be: an error is right where something is to be refused alone."""
    verdicts = [verdict for verdict, _ in found.values()]
    if case.honest:
        return set(verdicts) == {"pass"}
    return all(each in ("fail", "inconclusive") or (case.refused and each == "error 3") for each in verdicts)


def main() -> int:
    """Judge the cases and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("words", nargs="*", help="cases whose name holds one of them; all when none is given")
    parser.add_argument("--whole", action="store_true", help="the whole of optimize in the place of its judgement")
    given = parser.parse_args()
    kept = Path(tempfile.mkdtemp())
    wrong = counted = 0
    for case in CASES:
        if given.words and not any(word in case.name for word in given.words):
            continue
        place = Path(tempfile.mkdtemp())
        found = judge_case(case, place, kept, given.whole)
        shutil.rmtree(place)
        bad = not rightly(case, found)
        counted, wrong = counted + 1, wrong + bad
        verdicts = ", ".join(f"{way}: {verdict}" for way, (verdict, _) in found.items())
        print(f"{'WRONG' if bad else 'ok':5}  {case.name:46} {verdicts}", flush=True)
        print(f"       {next(iter(found.values()))[1][:230]}", flush=True)
    shutil.rmtree(kept)
    broken = sum(not case.honest for case in CASES)
    print(f"{counted} of {len(CASES)} cases ({broken} broken, {len(CASES) - broken} honest): {wrong} judged wrongly")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
