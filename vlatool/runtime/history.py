"""The last moments of an episode, for inputs that hold several."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.spec import PolicySpec

Array = NDArray[Any]


class History:
    """Moments before this one, of each input with a ``history``; the first of an episode stands for those before it.

    An inference in one thread and an observation in another may come at once, as on a robot that moves while its
    policy infers.

    Args:
        inputs: Inputs whose moments it holds; all that have a ``history`` when None.
    """

    def __init__(self, spec: PolicySpec, inputs: Collection[str] | None = None) -> None:
        self.lengths = {
            tensor.name: tensor.history for tensor in spec.inputs
            if tensor.history and (inputs is None or tensor.name in inputs)
        }  # fmt: skip
        self._before: dict[str, Array] = {}
        self._count = 0
        self._turn = threading.RLock()

    def window(self, name: str, moment: Array) -> Array:
        """Return the moments of an input up to this one, which is not kept yet.

        Args:
            moment: (1, ...), as the graphs take it.

        Returns:
            A new array (1, N, ...), oldest first.
        """
        newest, before = moment[:, None], self._before.get(name)
        if before is None:
            return np.repeat(newest, self.lengths[name], axis=1)
        return np.concatenate([before, newest], axis=1)

    @contextlib.contextmanager
    def with_moment(self, encode: Callable[[Mapping[str, Any]], dict[str, Array]], observation: Any) -> Iterator[Any]:
        """Keep an observation, and give it encoded to this block; one with which the block fails is not kept.

        After a failure, moments that were kept since stay.
        """
        with self._turn:
            values, earlier = encode(observation), self._before
            kept = self._before = {name: values[name][:, 1:].copy() for name in self.lengths}
            self._count += 1
        try:
            yield values
        except BaseException:
            with self._turn:
                if self._before is kept:
                    self._before = earlier
            raise

    @property
    def snapshot(self) -> tuple[int, dict[str, Array]]:
        """What ``restore`` takes: how many moments there were, and the last of them."""
        with self._turn:
            return self._count, self._before

    def restore(self, snapshot: tuple[int, dict[str, Array]]) -> None:
        """Forget the one moment that was kept since a snapshot; nothing where there were more."""
        with self._turn:
            if self._count == snapshot[0] + 1:
                self._before = snapshot[1]

    def forget(self) -> None:
        """Start a new episode."""
        with self._turn:
            self._before = {}
            self._count += 2
