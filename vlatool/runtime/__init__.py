"""What a robot controller imports: ``load`` a bundle, ``infer`` actions, ``reset``.

Needs numpy and one inference engine; never torch, onnx, pydantic, typer, rich or yaml.
"""

from __future__ import annotations

import os

from vlatool.runtime.chunks import ChunkQueue
from vlatool.runtime.policy import Action, Policy

__all__ = ["Action", "ChunkQueue", "Policy", "load"]


def load(
    path: str | os.PathLike[str],
    *,
    engine: str = "",
    threads: int | None = None,
    seed: int | None = None,
    warmup: int = 2,
    golden_tolerance: float = 0.25,
) -> Policy:
    """Load a bundle, verify it, open its graphs and warm them up.

    Args:
        path: The bundle directory.
        engine: Name of an engine, see ``vlatool doctor``; the one that the bundle was made for when empty.
        threads: Intra-op threads of the engine; the cores that this process may use when None.
        seed: Seed of the noise that a program draws; fresh entropy when None.
        warmup: Inferences on the golden observation before this returns (the first is the slowest).
        golden_tolerance: Largest relative L2 difference between the recorded golden action and this machine's.

    Raises:
        BundleError: the directory is missing, incomplete, changed or too new.
        SpecError: normalisation statistics or a tokenizer are missing or do not fit.
        GraphError: the engine refuses a graph, or computes something else than when the bundle was made.
        MissingExtra: the engine is not installed.

    Example:
        >>> policy = load("out/vln-babyai")                                            # doctest: +SKIP
        >>> policy.infer({"image": frames, "instruction": "go to the red ball"}).labels  # doctest: +SKIP
        ('forward',)
    """
    from vlatool.bundle import Bundle

    bundle = Bundle.described(path)
    bundle.verify("data/")
    policy = Policy.open(bundle, engine=engine, threads=threads, seed=seed)
    bundle.verify()
    policy.warm_up(warmup, golden_tolerance)
    return policy
