"""What the whole stack adds to ONNX Runtime's own ``run()``, call by call in turn, in one process.

    python tests/validation/stack/overhead.py BUNDLE --pairs 20000
    python tests/validation/stack/overhead.py --small --pairs 20000     # a product of 7 x 7, within a robot's envelope
    python tests/validation/stack/overhead.py --small --rate 100 --pairs 3000   # as a robot acts: idle in between
    python tests/validation/stack/overhead.py --layers                  # each layer of it in a loop of its own

Deadline, fallback and telemetry are on. Both calls of a pair get the same observation; who goes first alternates. A
pair counts where the stack infers. The processor's time is that of all threads of the process, which neighbours do not
lengthen; the rest is by the clock.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))
sys.path.insert(0, str(Path(__file__).parents[2] / "runtime"))
from _written import written

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.spec import TensorSpec
from vlatool.data import observations_for
from vlatool.runtime import load
from vlatool.runtime.control.chunked import ChunkQueue
from vlatool.runtime.control.deadline import Deadline
from vlatool.runtime.envelope import RobotLimits, envelope_of
from vlatool.runtime.stack import Fallback, Stack
from vlatool.runtime.telemetry import Telemetry
from vlatool.runtime.telemetry.cadence import Cadence
from vlatool.runtime.telemetry.json_lines import JsonLines
from vlatool.runtime.telemetry.prometheus import Prometheus

SHARES = (10, 50, 99, 99.9)
ROBOT = "franka-panda"


def small_bundle(folder: Path, hz: float = 10.0) -> str:
    """Write a policy that holds the pose of an arm of seven joints."""
    joints = tuple(joint.name for joint in RobotLimits.named(ROBOT).joints)
    pose = TensorSpec("q", (1, 7), labels=joints)
    action = TensorSpec("y", (1, 7), labels=joints, mode="absolute")
    text = f"g (float[1,7] q) => (float[1,7] y) <float[7,7] w = {{{', '.join(map(str, np.eye(7).ravel()))}}}>"
    return str(written(folder / "bundle", f"{text} {{ y = MatMul(q, w) }}", (pose,), (action,), hz=hz).path)


def differences(
    path: str,
    pairs: int,
    deadline_ms: float | None = None,
    robot: str | None = None,
    seen: Any = None,
    *,
    telemetry_on: bool = True,
    rate: float = 0.0,
) -> dict[str, np.ndarray]:
    """Return microseconds of the bare calls, of the stack's, and stack minus bare of each pair.

    Args:
        robot: Whose envelope is around the stack; its clock goes on by a control period with each step.
        seen: Observations; recorded or random ones when None.
        rate: Pairs in a second; one after the other when 0.
        telemetry_on: Whether lines of JSON, a file for Prometheus and a cadence report are written meanwhile.
    """
    plain = load(path, threads=1, seed=0)
    spec = plain.spec
    neutral = spec.action.labels[-1] if spec.action.kind == "discrete" else ""
    hold = Fallback(start=np.zeros(spec.action.robot_width), neutral=neutral)
    folder = Path(path).parent
    sinks = JsonLines(folder / "run.jsonl"), Prometheus(folder / "run.prom"), Cadence()
    limit = 0.9e3 / spec.rate if deadline_ms is None else deadline_ms
    telemetry = Telemetry(*sinks) if telemetry_on else None
    stack = load(path, threads=1, seed=0, envelope=robot, deadline_ms=limit, fallback=hold, telemetry=telemetry)
    assert isinstance(stack, Stack)
    if robot is not None:
        envelope = stack.controller.envelope
        envelope.clock = lambda: envelope._time + 1 / spec.rate if envelope.ready else 0.0
    observations = observations_for(Bundle.open(path), 16) if seen is None else seen
    step = plain.program.steps[0]
    session = getattr(plain.program.sessions[step.graph], "_session")  # noqa: B009
    feeds = [{name: plain.encode(each)[value] for name, value in step.feeds.items()} for each in observations]
    calls = ((lambda index: session.run(None, feeds[index])), (lambda index: stack.act(observations[index])))
    taken: tuple[list[float], ...] = ([], [], [], [])
    for pair in range(pairs + 200):
        if rate:
            time.sleep(1 / rate)
        times, counts = [0.0] * 4, True
        for kind in (0, 1) if pair % 2 else (1, 0):
            used, begin = time.process_time_ns(), time.perf_counter_ns()
            calls[kind](pair % len(observations))
            times[kind] = (time.perf_counter_ns() - begin) / 1e3
            times[2 + kind] = (time.process_time_ns() - used) / 1e3
            counts &= kind == 0 or (stack.fresh and stack.ladder.error is None)
        if pair >= 200 and counts:
            for values, value in zip(taken, times, strict=True):
                values.append(value)
    stack.close()
    bare, whole, bare_used, whole_used = map(np.array, taken)
    return {"bare run()": bare, "stack": whole, "stack minus bare, in pairs": whole - bare,
            "the same of the processor's time": whole_used - bare_used}  # fmt: skip


def layers(path: str, pose: dict[str, np.ndarray], count: int) -> dict[str, np.ndarray]:
    """Return microseconds of each call in a loop of its own: the engine, then one layer more each time.

    The clock of the envelope goes on by a control period with each step.
    """
    plain, inside = (load(path, threads=1, seed=0) for _ in range(2))
    deadline, player = Deadline(inside, 0.9e3 / plain.spec.rate), ChunkQueue(load(path, threads=1, seed=0))
    step = plain.program.steps[0]
    session = getattr(plain.program.sessions[step.graph], "_session")  # noqa: B009
    feeds = {name: plain.encode(pose)[value] for name, value in step.feeds.items()}
    ticks = itertools.count()
    envelope = envelope_of(plain.spec, RobotLimits.named(ROBOT), clock=lambda: next(ticks) / plain.spec.rate)
    envelope.start(pose["q"].tolist())
    action = plain.infer(pose).chunk[0]
    calls = {
        "bare run()": lambda: session.run(None, feeds), "infer()": lambda: plain.infer(pose),
        "a player": lambda: player.act(pose), "infer() with a deadline": lambda: deadline.infer(pose),
        "an envelope's step": lambda: envelope.step(action),
    }  # fmt: skip
    found = {}
    for name, call in calls.items():
        times = []
        for _ in range(count + 200):
            begin = time.perf_counter_ns()
            call()
            times.append((time.perf_counter_ns() - begin) / 1e3)
        found[name] = np.array(times[200:])
    deadline.close()
    return found


def main() -> None:
    """Print percentiles."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bundle", nargs="?", default="")
    parser.add_argument("--small", action="store_true", help="the small policy in the place of a bundle")
    parser.add_argument("--layers", action="store_true", help="each layer around the small policy by itself")
    parser.add_argument(
        "--rate", type=float, default=0.0, help="pairs in a second, as a robot acts; a busy loop when 0"
    )
    parser.add_argument("--without-telemetry", action="store_true", help="the same stack without its sinks")
    parser.add_argument("--pairs", type=int, default=20_000)
    parser.add_argument("--deadline-ms", type=float)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        pose = {"q": np.array([0.0, -0.8, 0.0, -2.3, 0.0, 1.6, 0.8], np.float32)}
        if options.layers:
            found = layers(small_bundle(Path(folder)), pose, options.pairs)
        elif options.small:
            found = differences(small_bundle(Path(folder)), options.pairs, options.deadline_ms, ROBOT, [pose],
                                telemetry_on=not options.without_telemetry, rate=options.rate)  # fmt: skip
        else:
            found = differences(options.bundle, options.pairs, options.deadline_ms,
                                telemetry_on=not options.without_telemetry, rate=options.rate)  # fmt: skip
    for name, values in found.items():
        shown = ", ".join(f"p{share:g} {np.percentile(values, share):.1f}" for share in SHARES)
        print(f"{name}: {shown} us (of {len(values)})")


if __name__ == "__main__":
    main()
