"""Run the latency gate many times, on the same bundle twice or on one that truly is slower, and count its verdicts.

    python tests/validation/soak/gate_trials.py BUNDLE --gates 200 -o out/same.jsonl
    python tests/validation/soak/gate_trials.py BUNDLE --gates 100 --slower 0.10 -o out/slower.jsonl
    python tests/validation/soak/gate_trials.py --resample 2000 -o out/same.jsonl

A neighbour process burns one core in bursts meanwhile (``--quiet``: none). The slower bundle has further matrix
products in its graph, as many as make it that much slower on this machine; nothing is scaled. Each gate is one line of
the output and is not run again when the command is: an interrupted series goes on. ``--resample`` draws gates from the
processes of a series, with replacement.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from statistics import median

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from vlatool.bundle.bundle import Bundle, seal
from vlatool.gate.claims.latency import Latency
from vlatool.gate.config import Gate
from vlatool.gate.run import run_gate
from vlatool.gate.verdict import Outcome, worst
from vlatool.measurement.pairs import PairJob, measure_pairs
from vlatool.stage.base import Context
from vlatool.stats.sequential import judge_jointly

NEIGHBOUR = """
import random, time
while True:
    end = time.monotonic() + random.uniform(0.05, 1.0)
    while time.monotonic() < end:
        sum(range(1000))
    time.sleep(random.uniform(0.05, 1.0))
"""
SIZE = 256


def main() -> int:
    """Run the series and print the counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bundle", type=Path, nargs="?")
    parser.add_argument("-o", "--output", type=Path, required=True, help="one line of JSON for each gate")
    parser.add_argument("--gates", type=int, default=200)
    parser.add_argument("--slower", type=float, default=0.0, help="share by which the candidate is slower")
    parser.add_argument("--margin", type=float, default=0.05)
    parser.add_argument("--quiet", action="store_true", help="without a neighbour")
    parser.add_argument("--resample", type=int, help="draw so many gates from the processes of the output")
    given = parser.parse_args()
    if given.resample:
        resampled(given.output, given.resample, given.margin)
        return 0
    given.output.parent.mkdir(parents=True, exist_ok=True)
    done = len(given.output.read_text().splitlines()) if given.output.exists() else 0
    with tempfile.TemporaryDirectory() as folder:
        base = Bundle.open(given.bundle)
        candidate = slower(base, given.slower, Path(folder)) if given.slower else base
        with contextlib.nullcontext() if given.quiet else neighbour():
            for number in range(done, given.gates):
                one_gate(candidate, base, given.margin, number, given.output)
    counted(given.output)
    return 0


def one_gate(candidate: Bundle, base: Bundle, margin: float, number: int, output: Path) -> None:
    """Run a gate on latency alone and append its line."""
    gate = Gate(latency=Latency(margin=margin), accuracy=None, answers=None, memory=None, size=None)
    begun = time.monotonic()
    report = run_gate(candidate, base, gate, Context(), seed=1000 * number)
    ratio = report.rows[1].get("latency_ratio")
    assert ratio is not None
    found = {"verdict": report.verdict, "ratio": ratio.value, "low": ratio.low, "high": ratio.high,
             "log_ratios": report.rows[1].raw["log_ratio"], "log_mean_ratios": report.rows[1].raw["log_mean_ratio"],
             "said": report.summary[1], "seconds": time.monotonic() - begun}  # fmt: skip
    with output.open("a") as stream:
        stream.write(json.dumps(found) + "\n")
    print(f"{number + 1}: {report.verdict} {ratio.value:.3f} after {ratio.samples} processes", flush=True)


def counted(output: Path) -> None:
    """Print the verdicts of a series."""
    lines = [json.loads(line) for line in output.read_text().splitlines()]
    print(f"{len(lines)} gates: {dict(Counter(line['verdict'] for line in lines))}, "
          f"after so many processes: {dict(Counter(len(line['log_ratios']) for line in lines))}")  # fmt: skip
    print(f"median ratio {median(line['ratio'] for line in lines):.4f}, "
          f"processes {np.mean([len(line['log_ratios']) for line in lines]):.1f} and "
          f"{median(line['seconds'] for line in lines):.0f} s a gate; standard deviation of a process "
          f"{np.std([value for line in lines for value in line['log_ratios']]):.3f}")  # fmt: skip


def resampled(output: Path, gates: int, margin: float) -> None:
    """Draw gates from the processes of a series, and print their verdicts."""
    lines = [json.loads(line) for line in output.read_text().splitlines()]
    pool = [both for line in lines for both in zip(line["log_ratios"], line["log_mean_ratios"], strict=True)]
    draw = random.Random(0)
    gate = (judge_jointly(lambda _: draw.choice(pool), 2, margin)[0] for _ in range(gates))
    found = Counter(worst(Outcome(decision.verdict) for decision in decisions).value for decisions in gate)
    print(f"{gates} gates drawn from {len(pool)} processes (median and mean): {dict(found)}")
    slow = sum("found an observation that is slower" in line["said"] for line in lines)
    print(f"{slow} of {len(lines)} gates found an observation that is slower each time")


@contextlib.contextmanager
def neighbour() -> Iterator[None]:
    """Burn one core in bursts meanwhile."""
    process = subprocess.Popen([sys.executable, "-c", NEIGHBOUR])
    try:
        yield
    finally:
        process.kill()


def slower(base: Bundle, share: float, folder: Path) -> Bundle:
    """Return a bundle that does more: the number of products is doubled, and then halved in, until it is that slow."""
    low, high = 0, 4
    while cost(base, found := with_products(base, high, folder / str(high))) < share:
        low, high = high, high * 2
    while high - low > max(1, high // 16):
        middle = (low + high) // 2
        found = with_products(base, middle, folder / str(middle))
        low, high = (middle, high) if cost(base, found) < share else (low, middle)
    found = with_products(base, high, folder / "candidate")
    print(f"{high} further products: {cost(base, found, 20):+.1%}", flush=True)
    return found


def cost(base: Bundle, candidate: Bundle, processes: int = 7) -> float:
    """Return by how much a bundle is slower, the median of some processes."""
    job = PairJob(str(base.path), str(candidate.path))
    return float(
        np.expm1(median(measure_pairs(PairJob(**{**vars(job), "seed": seed})).log_ratio for seed in range(processes)))
    )


def with_products(base: Bundle, count: int, out: Path) -> Bundle:
    """Return the bundle with further matrix products, whose result is added to its output, times next to nothing."""
    shutil.copytree(base.path, out)
    file = next(iter(base.manifest.graphs.values())).file
    model = onnx.load(out / file)
    graph = model.graph
    random_ = np.random.default_rng(0)
    result = graph.output[0].name
    last = next(node for node in graph.node if result in node.output)
    last.output[list(last.output).index(result)] = "own_result"
    graph.initializer.extend([
        numpy_helper.from_array((random_.normal(size=(SIZE, SIZE)) / SIZE**0.5).astype(np.float32), "more_weight"),
        numpy_helper.from_array(np.float32(1e-30), "more_tiny"),
        numpy_helper.from_array(np.zeros((8, SIZE), np.float32), "more_zeros"),
    ])  # fmt: skip
    nodes = [
        helper.make_node("ReduceSum", ["own_result"], ["more_sum"], keepdims=0),
        helper.make_node("Add", ["more_sum", "more_zeros"], ["more_0"]),
    ]
    for number in range(count):
        nodes.append(helper.make_node("MatMul", [f"more_{number}", "more_weight"], [f"more_product_{number}"]))
        nodes.append(helper.make_node("Tanh", [f"more_product_{number}"], [f"more_{number + 1}"]))
    nodes += [
        helper.make_node("ReduceSum", [f"more_{count}"], ["more_whole"], keepdims=0),
        helper.make_node("Mul", ["more_whole", "more_tiny"], ["more_nothing"]),
        helper.make_node("Add", ["own_result", "more_nothing"], [result]),
    ]
    graph.node.extend(nodes)
    assert graph.output[0].type.tensor_type.elem_type == TensorProto.FLOAT
    onnx.save(model, out / file)
    return seal(out, base.manifest)


if __name__ == "__main__":
    raise SystemExit(main())
