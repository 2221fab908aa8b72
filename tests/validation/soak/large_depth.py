"""Prune a policy whose weights are in shards, and print the most memory that each command had.

    # the sample smolvla-like, 450 M, 1.8 GB of shards
    python tests/validation/soak/large_depth.py --folder F --make smolvla
    python tests/validation/soak/large_depth.py -- vlatool prune depth F -o pruned ...
    # actions of a bundle beside those of torch
    python tests/validation/soak/large_depth.py --torch pruned --bundle pruned32

The memory is the most that a process had resident (VmHWM), summed over the command and all that it started.
``--folder F --make llama`` writes a policy of 6.7 billion parameters, 13.5 GB of bfloat16 shards. The blocks that
``--rank even`` lets go are zeros that take no place on the disk, so that it takes 7 GB: nothing reads them.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np


def make_llama(folder: Path) -> None:
    """Write a Llama-shaped policy, half of whose blocks are holes."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
    from _llama import write_llama

    from vlatool.prune.depth import evenly_spaced

    count = write_llama(folder, holes=tuple(sorted(set(range(32)) - set(evenly_spaced(32, 16)))))
    print(f"{count / 1e9:.3f} G parameters")


def make_smolvla(folder: Path) -> None:
    """Write the sample with its weights in two shards, named after its graphs."""
    import yaml
    from safetensors.torch import save_file

    from vlatool import registry
    from vlatool.samples import write_sample

    folder.mkdir(parents=True)
    write_sample("smolvla_like", folder, 0)
    described = yaml.safe_load((folder / "policy.yaml").read_text(encoding="utf-8"))
    (folder / "policy.py").write_text("from vlatool.samples.smolvla_like import make as make\n", encoding="utf-8")
    changed = {**described, "source": "policy.py:make", "weights": "*.safetensors"}
    (folder / "policy.yaml").write_text(yaml.safe_dump(changed, sort_keys=False), encoding="utf-8")
    for graph, module in registry.module("samples", "smolvla_like").make(**described["arguments"]).items():
        weights = {f"{graph}.{name}": value.contiguous() for name, value in module.state_dict().items()}
        save_file(weights, folder / f"{graph}.safetensors")
        print(f"{graph}: {sum(value.numel() for value in weights.values()) / 1e6:.0f} M parameters")


def descendants(pid: int) -> list[int]:
    """Return a process and all below it."""
    found = [pid]
    for each in found:
        with contextlib.suppress(OSError):
            for task in Path(f"/proc/{each}/task").iterdir():
                found += [int(child) for child in (task / "children").read_text().split()]
    return found


def measured(command: list[str]) -> int:
    """Run a command and print its seconds and peak memory."""
    peaks: dict[int, int] = {}
    together, start = 0, time.perf_counter()
    ended = threading.Event()
    process = subprocess.Popen(command)

    def watch() -> None:
        nonlocal together
        while not ended.wait(0.02):
            now = 0
            for each in descendants(process.pid):
                with contextlib.suppress(OSError, ValueError, KeyError):  # it ended
                    status = Path(f"/proc/{each}/status").read_text()
                    values = dict(line.split(":", 1) for line in status.splitlines())
                    peaks[each] = int(values["VmHWM"].split()[0]) * 1024
                    now += int(values["VmRSS"].split()[0]) * 1024
            together = max(together, now)

    thread = threading.Thread(target=watch)
    thread.start()
    code = process.wait()
    seconds = time.perf_counter() - start
    ended.set()
    thread.join()
    largest = max(peaks.values(), default=0)
    print(json.dumps({
        "seconds": round(seconds, 1), "exit": code, "largest_process_gb": round(largest / 1e9, 2),
        "processes_together_gb": round(together / 1e9, 2), "peaks_added_gb": round(sum(peaks.values()) / 1e9, 2),
    }))  # fmt: skip
    return code


def compare(source: Path, made: Path, count: int) -> float:
    """Return the largest relative difference of a bundle's actions from torch's, weights read one after the other."""
    from vlatool.bundle.bundle import Bundle
    from vlatool.data import observations_for
    from vlatool.module.description import read_location
    from vlatool.module.sharded_weights import stored_modules, weights_on_demand
    from vlatool.module.torch_policy import policy_of
    from vlatool.runtime import load
    from vlatool.runtime.policy import relative_error
    from vlatool.user_code import trust

    bundle = Bundle.open(source)
    trust.allow(read_location(source), None, "")
    stored, observations = stored_modules(bundle), observations_for(bundle, count)
    noises = [noise for step in bundle.manifest.program for noise in step.noise.items()]
    random = np.random.default_rng(0)
    drawn = [
        {name: random.standard_normal(each["shape"]).astype(np.float32) for name, each in noises} for _ in observations
    ]
    with weights_on_demand(stored):
        torch = policy_of(bundle, stored.modules, 0)
        wanted = [torch.infer(each, noise=noise).chunk for each, noise in zip(observations, drawn, strict=True)]
    policy = load(made)
    got = [policy.infer(each, noise=noise).chunk for each, noise in zip(observations, drawn, strict=True)]
    return max(relative_error(one, other) for one, other in zip(got, wanted, strict=True))


def main() -> int:
    """Make the sample, measure a command, or compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, help="where the policy is")
    parser.add_argument("--make", choices=["smolvla", "llama"], help="write it")
    parser.add_argument("--torch", type=Path, help="a pruned bundle")
    parser.add_argument("--bundle", type=Path, help="what was exported of it")
    parser.add_argument("--observations", type=int, default=4, help="on which they are compared")
    parser.add_argument("command", nargs="*", help="what is measured, after --")
    given = parser.parse_args()
    if given.make:
        (make_llama if given.make == "llama" else make_smolvla)(given.folder)
        return 0
    if given.torch:
        print(f"relative L2 difference from torch: {compare(given.torch, given.bundle, given.observations):.3g}")
        return 0
    return measured(given.command)


if __name__ == "__main__":
    sys.exit(main())
