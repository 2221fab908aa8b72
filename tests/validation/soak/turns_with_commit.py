"""What loading a policy and calling it cost, beside another commit, in turns.

    python tests/validation/soak/turns_with_commit.py COMMIT \\
        sample_models/vln-babyai sample_models/vla-metaworld --processes 30

Each commit is checked out, exports the policies itself, and measures in fresh processes that alternate in random
order: the first ``load`` of a process once the libraries are imported, and what ``infer`` takes beside the engine, call
by call, on the policy's own golden observation. The engine's own compiled call is timed inside it and taken away, at
the same place for both: what happens in Python on the way there counts, whoever wrote it.
"""

from __future__ import annotations

import argparse
import json
import random
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median

REPOSITORY = Path(__file__).parents[3]
MEASURE = """
import json, sys, time
sys.path.insert(0, sys.argv[1])
import numpy, onnxruntime
from statistics import median
from vlatool.runtime import load
try:
    from vlatool.runtime.golden import load_golden
except ImportError:  # an older commit
    from vlatool.runtime.policy import load_golden
import vlatool
assert vlatool.__file__.startswith(sys.argv[1]), vlatool.__file__
begun = time.perf_counter()
policy = load(sys.argv[2], threads=1, seed=0)
load_ms = (time.perf_counter() - begun) * 1e3
inside = [0]
class Timed:
    def __init__(self, engine):
        self._engine = engine
    def __getattr__(self, name):
        return getattr(self._engine, name)
def timed(name):
    def call(self, *given):
        begun = time.perf_counter_ns()
        found = getattr(self._engine, name)(*given)
        inside[0] += time.perf_counter_ns() - begun
        return found
    return call
for name in ("run", "run_with_iobinding"):
    setattr(Timed, name, timed(name))
for session in policy.program.sessions.values():
    wrapper = session._session
    wrapper._sess = Timed(wrapper._sess)
    if session._bound is None:
        continue
    if session._bound._start.__self__ is wrapper:
        session._bound._binding._session = wrapper._sess
    else:
        session._bound._start = wrapper._sess.run_with_iobinding
observation, noise, _ = load_golden(policy.bundle)
beside = []
for _ in range(int(sys.argv[3])):
    inside[0] = 0
    begun = time.perf_counter_ns()
    policy.infer(observation, noise=noise or None)
    beside.append((time.perf_counter_ns() - begun - inside[0]) / 1e3)
assert inside[0] > 0
print(json.dumps({"load_ms": load_ms, "beside_us": median(beside)}))
"""
UNITS = {"load_ms": "ms", "beside_us": "us"}


def main() -> int:
    """Measure, and print both sides and their difference."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("commit")
    parser.add_argument("policies", type=Path, nargs="+")
    parser.add_argument("--processes", type=int, default=30, help="of each commit")
    parser.add_argument("--calls", type=int, default=300, help="of infer in each process")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        other = Path(folder) / "checkout"
        git("worktree", "add", "--detach", str(other), given.commit)
        try:
            for policy in given.policies:
                compare(policy, (other, REPOSITORY), Path(folder), given.processes, given.calls)
        finally:
            git("worktree", "remove", "--force", str(other))
    return 0


def compare(policy: Path, roots: tuple[Path, Path], folder: Path, processes: int, calls: int) -> None:
    """Measure one policy."""
    bundles = [folder / f"{which}-{policy.name}" for which in (0, 1)]
    for root, bundle in zip(roots, bundles, strict=True):
        code = f"import sys; sys.path.insert(0, {str(root)!r}); from vlatool.__main__ import main; sys.exit(main())"
        command = [sys.executable, "-P", "-c", code, "export", str(root / policy), "-o", str(bundle)]
        subprocess.run(command, check=True, cwd=root, stdout=subprocess.DEVNULL)
    found: tuple[list[dict[str, float]], ...] = ([], [])
    for _ in range(processes):
        for which in random.sample((0, 1), 2):
            command = [sys.executable, "-P", "-c", MEASURE, str(roots[which]), str(bundles[which]), str(calls)]
            found[which].append(json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout))
    for name, unit in UNITS.items():
        before, after = ([each[name] for each in side] for side in found)
        middle = sorted(new - old for old, new in zip(before, after, strict=True))
        low, high = interval(middle)
        print(f"{policy.name} {name}: {median(before):.1f} -> {median(after):.1f} {unit}, median of the differences "
              f"{median(middle):+.1f} {unit} ({low:+.1f} to {high:+.1f} at 95 %), fastest {min(before):.1f} -> "
              f"{min(after):.1f}", flush=True)  # fmt: skip


def interval(ascending: list[float], draws: int = 2000) -> tuple[float, float]:
    """Return a bootstrap interval of the median."""
    chance = random.Random(0)
    medians = sorted(median(chance.choices(ascending, k=len(ascending))) for _ in range(draws))
    return medians[draws // 40], medians[-draws // 40]


def git(*arguments: str) -> None:
    """Run git in this repository."""
    subprocess.run(["git", "-C", str(REPOSITORY), *arguments], check=True, capture_output=True)


if __name__ == "__main__":
    raise SystemExit(main())
