"""Buffers that a traced module changes from call to call: an exported graph remembers nothing."""

from __future__ import annotations

from typing import Any

from vlatool.errors import SourceError

REMEDY = (
    "let forward() take it as an input and return it, and declare it with 'keep' in the program of policy.yaml: "
    "docs/guides/recurrent-policy.md"
)

STATISTICS = ("running_mean", "running_var", "num_batches_tracked")
"""Buffers of torch's normalisations, which change in training mode."""
EVALUATION = (
    "leave the module in evaluation mode: let forward() call no train(), nor a normalisation with training=True; "
    "statistics that shall change on the robot are declared with 'keep': docs/guides/recurrent-policy.md"
)


def refuse_changed_buffers(exported: Any, graph: str) -> None:
    """Look for buffers that a traced module changes and whose old value an output depends on.

    Args:
        exported: A ``torch.export.ExportedProgram``.

    Raises:
        SourceError: naming the first one.
    """
    signature = exported.graph_signature
    changed = {*signature.buffers_to_mutate.values()}
    for placeholder, buffer in signature.inputs_to_buffers.items():
        if buffer in changed and _reached(exported.graph, placeholder) & {*signature.user_outputs}:
            fix = EVALUATION if buffer.rpartition(".")[2] in STATISTICS else REMEDY
            raise forgets(graph, f"the buffer '{buffer}'", fix)


def _reached(graph: Any, start: str) -> set[str]:
    """Return the names of the nodes that a node's value flows into."""
    reached = {start}
    for node in graph.nodes:
        if any(source.name in reached for source in node.all_input_nodes):
            reached.add(node.name)
    return reached


def forgets(graph: str, what: str, fix: str = REMEDY) -> SourceError:
    """Return the error for a graph whose module remembers something that its outputs depend on."""
    return SourceError(
        f"The graph '{graph}' would forget: forward() changes {what} from call to call, and its outputs depend on it; "
        "an exported graph sees it as it is now, for ever.",
        fix,
    )
