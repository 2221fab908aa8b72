"""Random small ONNX graphs through every weight-only and int8 method: none may crash, and each result must be right.

    python tests/validation/soak/graphs_fuzz.py --graphs 200
    python tests/validation/soak/graphs_fuzz.py --graphs 40 --first 1000 --methods gptq awq

Prints one line for what went wrong and, at the end, a table: how many graphs each method quantized, refused with a
reason, quantized with a drift beyond its limit, or crashed on. Exit code 1 when there is a crash or a drift.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from _graph_trials import METHODS, Outcome, float_graph, trial
from _random_graphs import RandomGraph


def main() -> int:
    """Run, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--graphs", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, help="seed of the first graph")
    parser.add_argument("--methods", nargs="+", choices=sorted(METHODS), default=list(METHODS))
    given = parser.parse_args()
    outcomes: dict[str, list[Outcome]] = {word: [] for word in given.methods}
    for seed in range(given.first, given.first + given.graphs):
        graph = RandomGraph(seed)
        with tempfile.TemporaryDirectory(prefix="vlatool-fuzz-") as scratch:
            source = float_graph(graph, Path(scratch) / "graph")
            for word in given.methods:
                outcome = trial(graph, source, word)
                outcomes[word].append(outcome)
                if outcome.verdict in ("crash", "drift"):
                    print(f"{seed} {word} {outcome.verdict} {outcome.drift:.3f} {graph.words}\n{outcome.words}")
    return report(outcomes)


def report(outcomes: dict[str, list[Outcome]]) -> int:
    """Print the table and the reasons of refusals."""
    print(f"{'method':20} {'right':>6} {'refused':>8} {'drift':>6} {'crash':>6} {'mean':>8} {'worst':>8}")
    for word, found in outcomes.items():
        count = Counter(each.verdict for each in found)
        drifts = [each.drift for each in found if each.verdict in ("right", "drift")] or [0.0]
        print(f"{word:20} {count['right']:6} {count['refused']:8} {count['drift']:6} {count['crash']:6} "
              f"{np.mean(drifts):8.4f} {max(drifts):8.4f}")  # fmt: skip
    every = [each for found in outcomes.values() for each in found]
    reasons = Counter(re.sub(r"'[^']*'|/\S+", "*", each.words)[:150] for each in every if each.verdict == "refused")
    for words, number in reasons.most_common():
        print(f"refused {number:4}: {words}")
    return int(any(each.verdict in ("crash", "drift") for each in every))


if __name__ == "__main__":
    raise SystemExit(main())
