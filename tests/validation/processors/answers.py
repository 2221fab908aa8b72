"""What bundles answer on the processor that runs this, real or emulated: numpy, one engine and vlatool's runtime do.

Usage: python answers.py --observations FILE.npz -o DIRECTORY [--engine NAME] BUNDLE...

Prints one line of JSON for each bundle: whether ``load`` takes it (the golden check included), and in which file of
DIRECTORY the raw actions are, one row an observation. A bundle that ``load`` refuses is opened again without its golden
check, so that how wrong it is can be told.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vlatool import registry
from vlatool.bundle.bundle import Bundle
from vlatool.errors import VlatoolError
from vlatool.runtime import Policy, load
from vlatool.runtime.engine import DEFAULT_ENGINE

ANY = 1e300
"""A golden tolerance that every action keeps to."""
SEED = 0


def main() -> None:
    """Answer for every bundle."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bundles", nargs="+", type=Path)
    parser.add_argument("--observations", type=Path, required=True)
    parser.add_argument("--engine", default="")
    parser.add_argument("-o", "--output", type=Path, required=True)
    given = parser.parse_args()
    given.output.mkdir(parents=True, exist_ok=True)
    with np.load(given.observations, allow_pickle=False) as stored:
        observations = {name: stored[name] for name in stored.files}
    for bundle in given.bundles:
        start = time.perf_counter()
        answer = answered(bundle, observations, given.engine, given.output / f"{bundle.name}.npy")
        print(json.dumps({**answer, "seconds": round(time.perf_counter() - start, 1)}), flush=True)


def answered(path: Path, observations: Mapping[str, Any], engine: str, file: Path) -> dict[str, Any]:
    """Load a bundle, write its raw actions to a file where it can be made to run, and tell how it went."""
    told: dict[str, Any] = {"bundle": path.name, "refused": "", "why": "", "file": ""}
    try:
        policy = load(path, engine=engine, threads=1, seed=SEED)
    except VlatoolError as error:
        told.update(refused=type(error).__name__, why=error.message)
    try:
        if told["refused"]:
            policy = forced(path, engine)
        np.save(file, actions(policy, observations))
    except VlatoolError as error:
        return {**told, "refused": type(error).__name__, "why": told["why"] or error.message}
    told.update(file=file.name, golden=policy.golden_error, allowed=policy.golden_tolerances[0])
    session: Any = registry.load("engines", policy.engine or DEFAULT_ENGINE)
    return {**told, "arithmetic": session.arithmetic(), "engine": f"{policy.engine} {session.version()}"}


def forced(path: Path, engine: str) -> Policy:
    """Open a bundle that ``load`` refuses for what it computes.

    Raises:
        VlatoolError: when it is refused for something else.
    """
    findings = [finding["name"] for finding in Bundle.open_lazily(path).manifest.findings]
    return load(path, engine=engine, threads=1, seed=SEED, golden_tolerance=ANY, accept=findings)


def actions(policy: Policy, observations: Mapping[str, Any]) -> Any:
    """Return the raw action of each observation, (N, ...), each the first after a reset."""
    rows = []
    for index in range(len(next(iter(observations.values())))):
        seen = {name: values[index] for name, values in observations.items()}
        policy.reset()
        answer = policy.infer({name: str(each) if isinstance(each, np.str_) else each for name, each in seen.items()})
        rows.append(answer.outputs[policy.spec.action.name][0])
    return np.stack(rows)


if __name__ == "__main__":
    main()
