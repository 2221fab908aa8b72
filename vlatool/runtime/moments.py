"""Windows of moments: what a policy whose inputs look back is given where somebody else keeps the earlier moments."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import DataError

Array = NDArray[Any]


class MomentWindows:
    """Adds the moments before to observations, as they were given, for inputs with a ``history``.

    An open bundle does the same within itself; this is for one that answers several robots, or another machine.

    Args:
        every_step: Whether each control step is seen. Where it is not, an input has to come with all of its moments.
    """

    def __init__(self, spec: PolicySpec, *, every_step: bool = True) -> None:
        self._inputs = [tensor for tensor in spec.inputs if tensor.history]
        self._every_step = every_step
        self._moments: dict[str, deque[Array]] = {}

    def window(self, observation: Mapping[str, Any]) -> dict[str, Any]:
        """Return an observation with whole windows, (history, ...), and keep its moment.

        Before the first moment since ``forget`` there are copies of it.

        Raises:
            DataError: when an input is missing or has another shape, or is one moment where not every step is seen;
                nothing of the observation is kept then.
        """
        windows = {tensor.name: self._window(tensor, observation) for tensor in self._inputs}
        self._moments = windows
        return {**observation, **{name: np.stack(moments) for name, moments in windows.items()}}

    def forget(self) -> None:
        """Start a new episode."""
        self._moments = {}

    def _window(self, tensor: TensorSpec, observation: Mapping[str, Any]) -> deque[Array]:
        if tensor.name not in observation:
            raise DataError(f"The observation has no '{tensor.name}'.", f"give it: {tensor.name}")
        value, shape = (
            np.asarray(observation[tensor.name]),
            tuple(axis for axis in tensor.moment.observation.shape[1:] if isinstance(axis, int)),
        )
        if value.shape in (shape, (1, *shape)):
            return self._with_moment(tensor, value.reshape(shape))
        if value.shape in ((tensor.history, *shape), (1, tensor.history, *shape)):
            return deque(value.reshape(tensor.history, *shape), tensor.history)
        raise DataError(
            f"The input '{tensor.name}' has the shape {list(value.shape)}; allowed: one moment {list(shape)}, or "
            f"{tensor.history} of them.",
            f"give it as {[tensor.history, *shape]}",
        )

    def _with_moment(self, tensor: TensorSpec, moment: Array) -> deque[Array]:
        if not self._every_step:
            raise DataError(
                f"The input '{tensor.name}' is one moment; the policy looks back {tensor.history} control steps, and "
                "not every step is seen here.",
                f"give the last {tensor.history} moments, or infer at every step: --execute 1",
            )
        earlier = self._moments.get(tensor.name) or deque([moment] * tensor.history, tensor.history)
        return deque([*earlier, np.array(moment)], tensor.history)
