"""What a robot controller imports: ``load`` a bundle, ``infer`` actions, ``reset``.

Needs numpy and one inference engine; never torch, onnx, pydantic, typer, rich or yaml.
"""

from __future__ import annotations

import os
from collections.abc import Iterable

from vlatool.runtime.chunks import ChunkQueue
from vlatool.runtime.policy import Action, Policy, refuse_findings

__all__ = ["Action", "ChunkQueue", "Policy", "load"]


def load(
    path: str | os.PathLike[str],
    *,
    engine: str = "",
    threads: int | None = None,
    seed: int | None = None,
    warmup: int = 2,
    golden_tolerance: float | None = None,
    accept: Iterable[str] = (),
) -> Policy:
    """Load a bundle, verify it, open its graphs and warm them up.

    Args:
        path: The bundle directory.
        engine: Name of an engine, see ``vlatool doctor``; the one that the bundle was made for when empty.
        threads: Intra-op threads of the engine; the cores that this process may use when None.
        seed: Seed of the noise that a program draws; fresh entropy when None.
        warmup: Inferences on the golden observation before this returns (the first is the slowest).
        golden_tolerance: Largest relative L2 difference between the recorded golden action and this machine's; the one
            that was measured when the bundle was made when None.
        accept: Names of findings in the manifest that are overruled, see ``vlatool inspect``.

    Raises:
        BundleError: the directory is missing, incomplete, changed or too new.
        SpecError: normalisation statistics or a tokenizer are missing or do not fit.
        GraphError: the engine refuses a graph, or computes something else than the graph says, or a stage found the
            bundle to be wrong.
        MissingExtra: the engine is not installed.

    Example:
        >>> policy = load("out/vln-babyai")                                            # doctest: +SKIP
        >>> policy.infer({"image": frames, "instruction": "go to the red ball"}).labels  # doctest: +SKIP
        ('forward',)
    """
    from vlatool.bundle import Bundle

    bundle = Bundle.open(path)
    refuse_findings(bundle, accept)
    policy = Policy.open(bundle, engine=engine, threads=threads, seed=seed)
    policy.warm_up(warmup, golden_tolerance)
    return policy
