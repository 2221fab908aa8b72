"""Bundles of torch modules, as pruning and distillation make them, which have no graphs yet: how to export them."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

from vlatool.bundle.bundle import LOCATION, Bundle
from vlatool.errors import BundleError

POLICY = "POLICY"
"""Stands for the folder of the policy's code where it is not known, or gone."""
MAX_LOCATION_BYTES = 1 << 16
"""Bytes of ``location.json`` that are looked at."""


def factory_of(source: Bundle | None) -> str:
    """Return where the factory of a source bundle is, for messages; empty for a bundle that runs no code."""
    if source is None or source.manifest.graphs:
        return ""
    return str(source.manifest.source.get("factory", "")).rpartition(":")[0]


def no_graph_error(bundle: Bundle, purpose: str) -> BundleError:
    """Return the error of a bundle that has no graph, with the command that makes a bundle with graphs of it.

    Args:
        bundle: bundle without graphs.
        purpose: what the graph is needed for: ``run``.
    """
    return BundleError(f"{bundle.path} has no graph to {purpose}.", f"export it first: {export_command(bundle.path)}")


def export_command(bundle: Path) -> str:
    """Return the command that exports a bundle of modules; it trusts the policy's code, which the bundle lacks.

    Example:
        >>> export_command(Path("out/pruned"))
        'vlatool export out/pruned -o BUNDLE --trust POLICY'
    """
    return f"vlatool export {shlex.quote(str(bundle))} -o BUNDLE --trust {_folder(bundle)}"


def _folder(bundle: Path) -> str:
    """Return the folder of the policy's code, as the bundle notes it, for a shell."""
    try:
        with (bundle / LOCATION).open(encoding="utf-8") as stream:
            folder = json.loads(stream.read(MAX_LOCATION_BYTES))["folder"]
        known = isinstance(folder, str) and folder.isprintable() and Path(folder).is_absolute()
        return shlex.quote(folder) if known and Path(folder).is_dir() else POLICY
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return POLICY
