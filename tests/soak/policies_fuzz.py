"""Random small torch policies through export, every quantization method and both engines.

    python tests/soak/policies_fuzz.py --policies 300
    python tests/soak/policies_fuzz.py --policies 1 --first 17 --methods float16

None may end with what would be exit code 70, and no bundle that loads may answer with a drift from torch above the
method's limit. Prints a line for each of these and, at the end, a table: how many bundles of each method and engine
were right, refused with a reason, drifted or crashed. Exit code 1 when something crashed or drifted.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from _random_policies import RandomPolicy

from vlatool.bundle import Bundle
from vlatool.errors import VlatoolError
from vlatool.export._torch_policy import torch_policy
from vlatool.export.onnx import ExportOnnx
from vlatool.launch import run_transform
from vlatool.pipeline import source_stage
from vlatool.runtime import load
from vlatool.runtime.policy import relative_error
from vlatool.stage import Context, build_stage

ENGINES = ("ort_cpu", "openvino")
FLOAT, HALF, INT8, INT4 = 1e-3, 0.05, 0.25, 0.7
"""Largest relative L2 drift of the actions from torch, of networks of a few random layers."""
METHODS: dict[str, tuple[str, dict[str, Any], float]] = {
    "static": ("quantize.static_int8", {}, INT8),
    "static-all": ("quantize.static_int8", {"attention": True, "elementwise": True}, 2 * INT8),
    "static-qdq": ("quantize.static_int8", {"layout": "qdq"}, INT8),
    "static-openvino": ("quantize.static_int8", {"layout": "openvino"}, INT8),
    "dynamic": ("quantize.dynamic_int8", {}, INT8),
    "smooth": ("quantize.smooth_quant", {"insert": True, "outliers": 1.0}, FLOAT),
    "float16": ("quantize.float16", {}, HALF),
    "float8": ("quantize.float8", {}, INT8),
    "bfloat16": ("quantize.bfloat16", {}, HALF),
    "int8-weights": ("quantize.weight_only", {"bits": 8}, HALF),
    "int4": ("quantize.weight_only", {}, INT4),
    "int4-qdq": ("quantize.weight_only", {"layout": "qdq"}, INT4),
    "hqq": ("quantize.weight_only", {"method": "hqq"}, INT4),
    "gptq": ("quantize.weight_only", {"method": "gptq"}, INT4),
    "awq": ("quantize.weight_only", {"method": "awq"}, INT4),
}
"""Word -> stage, options, and the largest drift."""
FRESH = 1000
"""Added to a policy's seed for observations that calibration has not seen."""


@dataclass(frozen=True)
class Outcome:
    """What became of one bundle.

    Args:
        method: A key of ``METHODS``, or ``export``.
        engine: Which one loaded it; empty when it was not made.
        verdict: ``right``, ``refused``, ``drift`` or ``crash``.
        drift: Relative L2 drift of the actions from torch, where it ran.
        words: The reason.
    """

    method: str
    engine: str
    verdict: str
    drift: float = 0.0
    words: str = ""


def trials(policy: RandomPolicy, scratch: Path, methods: list[str]) -> Iterator[Outcome]:
    """Take a policy through everything."""
    made: list[Bundle] = []

    def export() -> Bundle:
        source = run_transform(
            source_stage(str(policy.write(scratch / "policy")))[0], None, scratch / "source", Context()
        )
        (scratch / "float").mkdir()
        made.append(source)
        return ExportOnnx().run(source, scratch / "float", Context())

    exported, failed = _tried("export", "", export)
    if exported is None:
        yield failed
        return
    wanted = _answers(torch_policy(made[0], seed=0), policy)
    yield from _loaded("export", exported, policy, wanted, FLOAT)
    for method in methods:
        stage, options, limit = METHODS[method]

        def quantize(stage: str = stage, options: dict[str, Any] = options, method: str = method) -> Bundle:
            return run_transform(build_stage(stage, options), exported, scratch / method, Context())  # type: ignore[arg-type]

        bundle, failed = _tried(method, "", quantize)
        if bundle is None:
            yield failed
        else:
            yield from _loaded(method, bundle, policy, wanted, limit)


def _loaded(method: str, bundle: Bundle, policy: RandomPolicy, wanted: list[Any], limit: float) -> Iterator[Outcome]:
    for engine in ENGINES:

        def answered(engine: str = engine) -> float:
            probe = engine == "openvino"  # it may end its process while it compiles
            got = _answers(load(bundle.path, engine=engine, threads=1, seed=0, probe=probe), policy)
            return relative_error(np.stack(got), np.stack(wanted))

        drift, failed = _tried(method, engine, answered)
        if drift is None:
            yield failed
        else:
            yield Outcome(method, engine, "right" if drift <= limit else "drift", drift, f"above {limit:g}")


def _answers(opened: Any, policy: RandomPolicy) -> list[Any]:
    """Return the actions for fresh observations, one after the other."""
    observations = policy.observations(4, policy.seed + FRESH)
    noises = [policy.noise(policy.seed + FRESH + turn) for turn in range(len(observations))]
    return [opened.infer(each, noise=noise).outputs["action"] for each, noise in zip(observations, noises, strict=True)]


def _tried(method: str, engine: str, work: Callable[[], Any]) -> tuple[Any, Outcome]:
    """Return what some work gives, or what it ended with."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return work(), Outcome(method, engine, "right")
    except VlatoolError as error:
        died = "SIG" in str(error)
        verdict = "crash" if error.exit_code == 70 or died else "refused"
        return None, Outcome(method, engine, verdict, words=str(error))
    except Exception:  # the seam: whatever is no error of vlatool's own would be exit code 70
        return None, Outcome(method, engine, "crash", words=traceback.format_exc())


def main() -> int:
    """Run, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policies", type=int, default=300)
    parser.add_argument("--first", type=int, default=0, help="seed of the first policy")
    parser.add_argument("--methods", nargs="+", choices=sorted(METHODS), default=list(METHODS))
    parser.add_argument("-o", "--output", type=Path, help="a line of JSON for each outcome, as they come")
    given = parser.parse_args()
    outcomes: list[Outcome] = []
    for seed in range(given.first, given.first + given.policies):
        policy = RandomPolicy(seed)
        with tempfile.TemporaryDirectory(prefix="vlatool-fuzz-") as scratch:
            for outcome in trials(policy, Path(scratch), given.methods):
                outcomes.append(outcome)
                if given.output:
                    with given.output.open("a") as stream:
                        stream.write(json.dumps({"seed": seed, "policy": policy.words, **vars(outcome)}) + "\n")
                if outcome.verdict in ("crash", "drift"):
                    print(f"{seed} {outcome.method} {outcome.engine} {outcome.verdict} {outcome.drift:.3g} "
                          f"({policy.words})\n{outcome.words}", flush=True)  # fmt: skip
    return report(outcomes)


def report(outcomes: list[Outcome]) -> int:
    """Print the table and the reasons of refusals."""
    print(f"{'method':16} {'engine':9} {'right':>6} {'refused':>8} {'drift':>6} {'crash':>6} {'worst':>9}")
    for method, engine in dict.fromkeys((each.method, each.engine) for each in outcomes):
        found = [each for each in outcomes if (each.method, each.engine) == (method, engine)]
        count = Counter(each.verdict for each in found)
        print(f"{method:16} {engine or '(made)':9} {count['right']:6} {count['refused']:8} {count['drift']:6} "
              f"{count['crash']:6} {max(each.drift for each in found):9.2g}")  # fmt: skip
    reasons = Counter(
        re.sub(r"'[^']*'|/\S+|[\d.]+", "*", each.words)[:150] for each in outcomes if each.verdict == "refused"
    )
    for words, number in reasons.most_common():
        print(f"refused {number:4}: {words}")
    return int(any(each.verdict in ("crash", "drift") for each in outcomes))


if __name__ == "__main__":
    sys.exit(main())
