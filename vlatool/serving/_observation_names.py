"""From the names that a client uses to the inputs of the policy."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.bundle.spec import PolicySpec
from vlatool.data import Steps
from vlatool.errors import DataError, UsageError, fix_for, suggest

WHERE = Path("The observation")


class ObservationNames:
    """Takes what the inputs of a policy need out of the values that a client sends.

    Args:
        spec: Of the policy.
        names: Input -> name that clients use, where they differ; also a part of a vector, or several: ``state[0:7]``,
            ``arm+gripper``.

    Raises:
        UsageError: for a name that the inputs of the policy lack.
    """

    def __init__(self, spec: PolicySpec, names: Mapping[str, str] | None = None) -> None:
        inputs = [tensor.name for tensor in spec.inputs]
        for name in names or {}:
            if name not in inputs:
                raise UsageError(f"The policy has no input '{name}'; {suggest(name, inputs)}.", fix_for(name, inputs))
        self.sources = {name: (names or {}).get(name, name) for name in inputs}

    def __call__(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return the inputs by name; other values of the client are left out.

        Raises:
            DataError: naming every input that is missing, under the name that the client should use.
        """
        found, missing = {}, []
        for name, source in self.sources.items():
            if source in values:
                found[name] = values[source]
            elif "[" in source or "+" in source:
                found[name] = self._part(values, source)
            else:
                missing.append(source if source == name else f"{source} (for {name})")
        if missing:
            has = ", ".join(sorted(values)[:20])[:400] or "nothing"
            raise DataError(
                f"The observation lacks {', '.join(missing)}; it has: {has}.",
                "send these names, or map them where the policy is served: --map INPUT=NAME",
            )
        return found

    def _part(self, values: Mapping[str, Any], source: str) -> Any:
        columns = {name: value[None] for name, value in values.items() if isinstance(value, np.ndarray)}
        return Steps(WHERE, columns, np.zeros(1, np.int64)).column(source)[0]
