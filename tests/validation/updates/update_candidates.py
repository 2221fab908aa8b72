"""Bad new bundles, each really deployed and run by a controller process: all are refused or rolled back.

Usage: python tests/validation/updates/update_candidates.py [--only NAME]

A candidate may be slow, wrong in a number, of another contract, hang, kill its process at tick k, grow, or be
exchanged in its slot for another one. What a deployment refuses never becomes active; what shows on the robot alone is
rolled back by the trial. In the end the bundle before answers, in a fresh process, and no action was mixed.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

import numpy as np
import onnx
import onnx.parser
from _slots import bundle_of

from vlatool.bundle.bundle import Bundle, seal
from vlatool.deployment.deploy import Conditions, deploy
from vlatool.deployment.store import Store
from vlatool.errors import VlatoolError
from vlatool.files.npz import open_npz
from vlatool.stage.finish import save_npz

TICKS, RESTARTS = 40, 6
CONTROLLER = """\
import os, signal, sys
import numpy as np
sys.path.insert(0, sys.argv[3])
from vlatool.deployment.slot_policy import SlotPolicy
from vlatool.runtime import load

kind, ticks, ballast = sys.argv[2], int(sys.argv[4]), []


class Faulty:
    def __init__(self, policy):
        self.policy, self.spec, self.bundle, self.count = policy, policy.spec, policy.bundle, 0

    def infer(self, observation, *, noise=None):
        self.count += 1
        if kind.startswith("crash") and self.count == int(kind.rpartition(" ")[2]):
            os.kill(os.getpid(), signal.SIGSEGV)
        if kind == "leaks on the robot":
            ballast.append(np.ones(500_000))
        return self.policy.infer(observation, noise=noise)

    def reset(self, seed=None):
        self.policy.reset(seed)


def opened(path):
    policy = load(path, threads=1)
    if kind == "crashes when it is opened" and policy.infer({"x": [1.0, 2.0]}).chunk[0, 0] == 2:
        os.abort()
    return Faulty(policy) if policy.infer({"x": [1.0, 2.0]}).chunk[0, 0] == 2 else policy


value = 20.0 if kind.endswith("on the robot") else 1.0
with SlotPolicy(sys.argv[1], open_policy=opened) as policy:
    for tick in range(ticks):
        chunk = policy.infer({"x": [value, 2.0]}).chunk
        assert np.isfinite(chunk).all() and len(set(chunk.ravel().tolist())) == 1, chunk
    print("answers", chunk[0, 0], "after", list(policy.events))
"""


@dataclass(frozen=True)
class Candidate:
    """A bundle that must not stay.

    Args:
        body: text of its graph after the constants ``a`` (axis) and ``v`` (its answer); the plain one when empty.
        change: function that changes its directory or store before it is deployed or run.
        deployed: whether the deployment accepts it: only the trial can find it out.
        latency_ms: limit on an inference in ms.
    """

    body: str = ""
    deployed: bool = False
    latency_ms: float = 300.0
    control_hz: float = 10.0
    change: Callable[[Path], object] | None = None


LOOP = """n = Sub(x, x)
    y = Loop (trips, go, v) <body = b (int64 i, bool c, float[1,3,2] s) => (bool d, float[1,3,2] e) {
        d = Identity(c)  e = Abs(s) }>"""
NAN = """k = Constant<value_float = 10.0>()  z = Sub(k, x)  l = Log(z)  m = Sub(l, l)
    u = Unsqueeze(m, a)  y = Add(v, u)"""
HUGE = """h = Constant<value_ints = [400000000]>()  o = ConstantOfShape(h)  r = ReduceSum(o)  p = Mul(r, r)
    n = Mul(x, p)  u = Unsqueeze(n, a)  y = Add(v, u)"""


def exchange(folder: Path) -> None:
    """Put another whole bundle into the slot after it was verified."""
    shutil.rmtree(folder)
    with tempfile.TemporaryDirectory() as place:
        shutil.copytree(bundle_of(Path(place) / "other", 3).path, folder)


def wrong_golden(folder: Path) -> None:
    """Record another golden action than the graph computes."""
    arrays = dict(open_npz(folder / "golden/golden.npz"))
    save_npz(folder / "golden/golden.npz", {**arrays, "out.y": arrays["out.y"] + 1})


CANDIDATES = {
    "slow": Candidate(LOOP.replace("trips", "n5"), latency_ms=0.05),
    "hangs": Candidate(LOOP.replace("trips", "n62")),
    "NaN on recorded observations": Candidate(NAN),
    "NaN on the robot": Candidate(NAN, deployed=True),
    "needs much memory": Candidate(HUGE),
    "another contract": Candidate(control_hz=20.0),
    "wrong golden action": Candidate(change=wrong_golden),
    "a changed file": Candidate(change=lambda folder: (folder / "graphs/main.onnx").write_bytes(b"x")),
    "crashes when it is opened": Candidate(deployed=True),
    **{f"crashes at tick {tick}": Candidate(deployed=True) for tick in (1, 2, 7, 39)},
    "leaks on the robot": Candidate(deployed=True),
    "another identity in the slot": Candidate(deployed=True, change=exchange),
    "a damaged slot": Candidate(deployed=True, change=lambda folder: (folder / "graphs/main.onnx").write_bytes(b"x")),
}
"""Name -> candidate; the observations of "NaN on recorded observations" have a value of 20."""


def made(name: str, candidate: Candidate, folder: Path) -> Bundle:
    """Make a candidate, which answers 2."""
    bundle = bundle_of(folder, 2, "1.1.0", control_hz=candidate.control_hz)
    if candidate.body:
        values = ", ".join(["2.0"] * 6)
        constants = f"int64[1] a = {{1}}, int64 n5 = {{20000}}, int64 n62 = {{{2**62}}}, bool go = {{1}}"
        constants += f", float[1,3,2] v = {{{values}}}"
        text = f"g (float[1,2] x) => (float[1,3,2] y) <{constants}> {{ {candidate.body} }}"
        onnx.save(onnx.parser.parse_model(f'<ir_version: 10, opset_import: ["" : 20]> {text}'),
                  str(folder / "graphs/main.onnx"))  # fmt: skip
    if candidate.change is not None and not candidate.deployed:
        candidate.change(folder)
    return bundle if name == "a changed file" else seal(folder, bundle.manifest)


def outcome(name: str, candidate: Candidate, folder: Path) -> tuple[bool, str]:
    """Return whether a candidate had the end that it should, and which one that was."""
    store = Store(folder / "store")
    deploy(store, bundle_of(folder / "before", 1).path, Conditions(runs=32), lambda _what, _share: None)
    recording = folder / "recording.npz"
    np.savez(recording, x=np.array([[1, 2], [20 if name == "NaN on recorded observations" else 2, 2]], np.float32))
    conditions = Conditions(latency_ms=candidate.latency_ms, runs=32, recording=str(recording), first_run_s=2.0,
                            memory_mb=64.0, ticks=10 * TICKS, seconds=0)  # fmt: skip
    try:
        deploy(store, made(name, candidate, folder / "candidate").path, conditions, lambda _what, _share: None)
    except VlatoolError as error:
        pointer = store.read()
        kept = pointer.active == "a" and answers(store, name, 2)[0]
        return kept and not candidate.deployed, f"refused: {type(error).__name__}: {error.message}"
    if not candidate.deployed:
        return False, "was deployed"
    if candidate.change is not None:
        candidate.change(store.folder(store.read().active))
    starts, right, said = 0, False, ""
    while not right and starts < RESTARTS:
        starts += 1
        right, said = answers(store, name, TICKS)
    return right and store.read().active == "a", f"rolled back after {starts} starts: {store.read().rollback or said}"


def answers(store: Store, name: str, ticks: int) -> tuple[bool, str]:
    """Run a controller; return whether its last action was that of the bundle before, and what it said."""
    words = [sys.executable, "-c", CONTROLLER, str(store.path), name, str(Path(__file__).parents[2]), str(ticks)]
    own = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(words, capture_output=True, text=True, check=False, env=own)
    return "answers 1.0" in done.stdout, (done.stdout or done.stderr)[-300:]


def main() -> int:
    """Print a line for each candidate; 1 when one did not have the end that it should."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="")
    given = parser.parse_args()
    failed = 0
    for name, candidate in CANDIDATES.items():
        if given.only not in name:
            continue
        with tempfile.TemporaryDirectory() as folder:
            right, what = outcome(name, candidate, Path(folder))
        print(f"{'ok   ' if right else 'WRONG'}  {name}: {' '.join(what.split())[:200]}", flush=True)
        failed += not right
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
