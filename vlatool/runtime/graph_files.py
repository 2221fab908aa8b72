"""A graph of a bundle, opened by an engine as the very bytes that were verified."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.manifest import Graph
from vlatool.errors import BundleError
from vlatool.files.limits import MIB
from vlatool.files.validate import path_problem, short_repr
from vlatool.files.verified_read import open_inside
from vlatool.machine.engine_calls import engine_call
from vlatool.runtime.external_data import OpenFile, external_files

WHOLE = 4 * MIB
"""Bytes of a graph up to which the engine gets its content; a larger one would be in memory twice."""


def open_graph(
    bundle: Bundle,
    graph: Graph,
    engine: Callable[..., Any],
    threads: int | None,
    traced: bool = False,
    shapes: Mapping[str, tuple[int, ...]] | None = None,
) -> Any:
    """Return the session of an engine on a graph of a bundle.

    The engine gets the verified content. A graph that is large or has weights beside it is opened by name, in a
    directory that nothing else can take the place of, and must be the same before and after.

    Args:
        bundle: Where it is; its files are verified here.
        engine: A class of ``vlatool/runtime/engines``.
        traced: Whether the session is to tell what it ran (``node_runs``), where the engine can.
        shapes: Input of the graph -> its shape, where all are known, for an engine that builds something of its own.

    Raises:
        BundleError: when a file is not what the manifest says or is changed meanwhile, or the graph keeps weights in a
            file that the manifest does not record.
        GraphError: when the engine refuses the graph.
    """
    with engine_call(engine, f"opened the graph '{graph.file.rpartition('/')[2].removesuffix('.onnx')}'"):
        more: dict[str, Any] = {"traced": True} if traced and getattr(engine, "traces", False) else {}
        more |= {"shapes": shapes} if getattr(engine, "caches", False) else {}
        return _opened(bundle, graph, functools.partial(engine, **more), threads)


def _opened(bundle: Bundle, graph: Graph, engine: Callable[..., Any], threads: int | None) -> Any:
    folder, _, name = graph.file.rpartition("/")
    path = bundle.path / graph.file
    record = bundle.manifest.files.get(graph.file)
    if record is None or record.bytes <= WHOLE:
        content = bundle.read(graph.file)
        if not external_files(content):
            return engine(path, threads, graph.compute, content, **_cache_key(bundle, engine, [graph.file]))
        del content
    with contextlib.ExitStack() as stack:
        own = stack.enter_context(bundle.verified_folder(folder, [graph.file]))
        with open_inside(own, name) as handle:
            locations = external_files(OpenFile(handle))
        if beside := recorded_files(bundle, graph.file, locations):
            stack.enter_context(bundle.verified_folder(folder, beside))
        keyed = _cache_key(bundle, engine, [graph.file, *beside])
        return engine(path, threads, graph.compute, own / name, **keyed)


def _cache_key(bundle: Bundle, engine: Callable[..., Any], files: Iterable[str]) -> dict[str, str]:
    """Return the hash of files as an argument, for an engine that keeps what it builds from them."""
    if "shapes" not in getattr(engine, "keywords", {}):
        return {}
    return {"cache": " ".join(bundle.manifest.files[file].sha256 for file in files if file in bundle.manifest.files)}


def recorded_files(bundle: Bundle, file: str, locations: Iterable[str]) -> list[str]:
    """Return a bundle's files that a graph's locations mean; raises BundleError when one is outside or unrecorded."""
    folder = file.rpartition("/")[0]
    files = []
    for location in sorted(locations):
        name = f"{folder}/{location}" if folder else location
        reason = path_problem(location) or ("" if name in bundle.manifest.files else "the manifest does not record it")
        if reason:
            raise BundleError(
                f"The graph {file} of {bundle.path} keeps weights in {short_repr(location)}: {reason}.",
                "export the policy again",
            )
        files.append(name)
    return files
