"""Random small torch policies through export, every quantization method and both engines.

    python tests/validation/soak/policies_fuzz.py --policies 300 --jobs 2 -o outcomes.jsonl
    python tests/validation/soak/policies_fuzz.py --policies 1 --first 17 --methods float16
    python tests/validation/soak/policies_fuzz.py --table outcomes.jsonl

None may end with what would be exit code 70, or end its process, and no bundle that loads may answer with a drift from
torch above the method's limit. Prints a line for each of these and, at the end, a table: how many bundles of each
method and engine were right, refused with a reason, drifted (``uncovered``: because the recording does not cover what
it is asked, which is tried again with a recording that does) or crashed. Exit code 1 when something crashed or drifted,
or torch's export of a policy was refused.
Policies run in worker processes; with ``-o``, what the file tells already is not tried again.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Lock
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from _policy_trials import EXPORT, METHODS, Outcome, Place, places, trials
from _random_policies import RandomPolicy

Told = dict[str, Any]


class Journal:
    """The outcomes of a run, one line of JSON each, in a file where one is given.

    Args:
        path: The file; lines that are in it count.
        methods: Those that the run is about.
    """

    def __init__(self, path: Path | None, methods: Collection[str]) -> None:
        self.path, self.lock = path, Lock()
        found = [json.loads(line) for line in path.read_text().splitlines()] if path and path.exists() else []
        self.lines: list[Told] = [each for each in found if each["method"] in (EXPORT, *methods)]

    def add(self, seed: int, outcome: Outcome) -> None:
        """Note an outcome and print a bad one."""
        policy = RandomPolicy(seed).words
        with self.lock:
            self.lines.append({"seed": seed, "policy": policy, **vars(outcome)})
            if self.path:
                with self.path.open("a") as stream:
                    stream.write(json.dumps(self.lines[-1]) + "\n")
            if bad(outcome):
                print(f"{seed} {outcome.method} {outcome.engine} {outcome.verdict} {outcome.drift:.3g} ({policy})\n"
                      f"{outcome.words}", flush=True)  # fmt: skip

    def known(self, seed: int) -> set[Place]:
        """Return what need not be tried of a policy any more; what was not made cannot be loaded."""
        told = [each for each in self.lines if each["seed"] == seed]
        unmade = [place for each in told if not each["engine"] for place in places(each["method"])]
        return {*((each["method"], each["engine"]) for each in told), *unmade}


class Worker:
    """A process that takes policies through everything; another one follows when it is ended by one of them."""

    def __init__(self, journal: Journal, methods: Collection[str]) -> None:
        self.journal, self.methods = journal, list(methods)
        self.process: subprocess.Popen[str] | None = None

    def run(self, seed: int) -> None:
        """Take one policy through what is not known of it yet."""
        while True:
            known = self.journal.known(seed)
            if (EXPORT, "") in known or all(place in known for word in self.methods for place in places(word)):
                return
            if (ended := self._asked(seed, known)) is not None:
                self.journal.add(seed, ended)

    def _asked(self, seed: int, known: Collection[Place]) -> Outcome | None:
        """Return what ended the process, None when all was answered."""
        process = self.process = self.process or _started()
        assert process.stdin
        assert process.stdout
        process.stdin.write(json.dumps({"seed": seed, "methods": self.methods, "skip": sorted(known)}) + "\n")
        process.stdin.flush()
        begun: Place = (EXPORT, "")
        for line in process.stdout:
            told = json.loads(line)
            if "done" in told:
                return None
            if "begin" in told:
                begun = (told["begin"][0], told["begin"][1])
            else:
                self.journal.add(seed, Outcome(**told))
        process.stdin.close()
        process.stdout.close()
        code, self.process = process.wait(), None
        reason = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        return Outcome(*begun, "crash", words=f"ends its process with {reason}")

    def end(self) -> None:
        """Let the process end."""
        if self.process and self.process.stdin and self.process.stdout:
            self.process.stdin.close()
            self.process.wait()
            self.process.stdout.close()


def _started() -> subprocess.Popen[str]:
    command = [sys.executable, str(Path(__file__).resolve()), "--serve"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment)


def serve() -> int:
    """Answer the questions on standard input: the worker's side."""
    from torch.onnx._internal.exporter._registration import ONNXRegistry

    # what torch knows of its operators is the same for every export, and a sixth of the time of a policy
    ONNXRegistry.from_torchlib = staticmethod(functools.cache(ONNXRegistry.from_torchlib))  # type: ignore[assignment]
    replies = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what the engines print is no answer
    for line in sys.stdin:
        asked = json.loads(line)
        skip = {(method, engine) for method, engine in asked["skip"]}
        with tempfile.TemporaryDirectory(prefix="vlatool-fuzz-") as scratch:
            tell = _told(replies)
            for outcome in trials(RandomPolicy(asked["seed"]), Path(scratch), asked["methods"], skip, tell):
                replies.write(json.dumps(vars(outcome)) + "\n")
        replies.write('{"done": true}\n')
    return 0


def _told(replies: Any) -> Any:
    return lambda place: replies.write(json.dumps({"begin": place}) + "\n")


def main() -> int:
    """Run, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policies", type=int, default=300)
    parser.add_argument("--first", type=int, default=0, help="seed of the first policy")
    parser.add_argument("--seeds", type=int, nargs="+", help="these alone")
    parser.add_argument("--methods", nargs="+", choices=sorted(METHODS), default=list(METHODS))
    parser.add_argument("--jobs", type=int, default=1, help="worker processes")
    parser.add_argument("-o", "--output", type=Path, help="a line of JSON for each outcome, as they come")
    parser.add_argument("--table", type=Path, help="print the table of such a file and run nothing")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.serve:
        return serve()
    journal = Journal(given.table or given.output, given.methods)
    seeds = given.seeds or range(given.first, given.first + given.policies)
    if not given.table:
        run(journal, iter(seeds), given.methods, given.jobs)
    return report([_outcome(each) for each in journal.lines if given.table or each["seed"] in seeds])


def run(journal: Journal, seeds: Iterator[int], methods: Collection[str], jobs: int) -> None:
    """Share policies among worker processes."""
    lock = Lock()

    def work(_: int) -> None:
        worker = Worker(journal, methods)
        while True:
            with lock:
                seed = next(seeds, None)
            if seed is None:
                return worker.end()
            worker.run(seed)

    with ThreadPoolExecutor(jobs) as pool:
        list(pool.map(work, range(jobs)))


def _outcome(told: Told) -> Outcome:
    return Outcome(**{name: told[name] for name in ("method", "engine", "verdict", "drift", "words")})


def bad(outcome: Outcome) -> bool:
    """Say whether the fuzz has found something; torch can export each of these policies."""
    return outcome.verdict in ("crash", "drift") or (outcome.verdict, outcome.method) == ("refused", EXPORT)


def report(outcomes: Iterable[Outcome]) -> int:
    """Print the table and the reasons of refusals."""
    outcomes = list(outcomes)
    verdicts = ("right", "refused", "uncovered", "drift", "crash")
    print(f"{'method':16} {'engine':9}" + "".join(f"{word:>10}" for word in (*verdicts, "worst")))
    order = [EXPORT, *METHODS]
    for method, engine in sorted({(each.method, each.engine) for each in outcomes}, key=lambda at: order.index(at[0])):
        found = [each for each in outcomes if (each.method, each.engine) == (method, engine)]
        count = Counter(each.verdict for each in found)
        worst = max((each.drift for each in found if each.verdict != "uncovered"), default=0.0)
        told = "".join(f"{count[word]:10}" for word in verdicts)
        print(f"{method:16} {engine or '(made)':9}{told}{worst:10.2g}")
    reasons = Counter(
        (each.method, each.engine, re.sub(r"'[^']*'|/\S+|[\d.]+", "*", each.words)[:150])
        for each in outcomes if each.verdict == "refused"
    )  # fmt: skip
    for (method, engine, words), number in reasons.most_common():
        print(f"refused {number:4} {method} {engine or '(made)'}: {words}")
    return int(any(bad(each) for each in outcomes))


if __name__ == "__main__":
    sys.exit(main())
