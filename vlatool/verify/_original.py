"""The code that a policy was made from: ``act``, and where they are beside it ``preprocess``, ``raw``, ``reset``."""

from __future__ import annotations

import copy
import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import SourceError, VlatoolError
from vlatool.files.printable import message_of
from vlatool.module.factory import import_factory, map_user_exceptions
from vlatool.runtime.interface import Array


class Original:
    """Calls a user's functions; what they raise, and an answer of the wrong kind, becomes one sentence.

    Args:
        factory: ``original.py:act`` or ``package.module:act``.
        folder: what a path counts from.
    """

    def __init__(self, factory: str, folder: Path, spec: PolicySpec) -> None:
        self._name = factory
        self._spec = spec
        self._act = import_factory(factory, folder)
        beside = getattr(self._act, "__globals__", {})
        self._preprocess = _function(beside, "preprocess")
        self._raw = _function(beside, "raw")
        self._reset = _function(beside, "reset")
        self.takes_noise = _takes(self._act, "noise")

    @property
    def hooks(self) -> bool:
        """Whether both stages between observation and action can be asked for."""
        return self._preprocess is not None and self._raw is not None

    def reset(self) -> None:
        """Begin an episode, where the code has a function for it."""
        if self._reset is not None:
            self._call(self._reset, "reset", -1)

    def act(self, observation: Mapping[str, Any], noise: Mapping[str, Array], number: int) -> Array:
        """Return its action: (T, A) float64 in physical units, T at most the chunk; or (T,) int64 indices."""
        answer = self._call(self._act, "act", number, observation, **self._noise(self._act, noise))
        return self._indices(answer, number) if self._spec.action.kind == "discrete" else self._chunk(answer, number)

    def preprocess(self, observation: Mapping[str, Any], number: int) -> dict[str, Array]:
        """Return what its network takes, as far as it tells it: input name -> array; nothing when it has no function.

        Raises:
            SourceError: when it gives something else than a mapping of inputs to arrays.
        """
        if self._preprocess is None:
            return {}
        answer = self._call(self._preprocess, "preprocess", number, observation)
        names = [tensor.name for tensor in self._spec.inputs]
        if not isinstance(answer, Mapping) or not answer or not set(answer) <= set(names):
            got = ", ".join(map(str, answer)) if isinstance(answer, Mapping) else f"a {type(answer).__name__}"
            raise SourceError(
                f"preprocess() beside '{self._name}' gives {got or 'nothing'}; wanted a dict with some of "
                f"{', '.join(names)}.",
                "return what the network takes, by the names in policy.yaml",
            )
        open_ = {tensor.name for tensor in self._spec.inputs if not tensor.finite}
        return {
            name: self._array(value, f"preprocess()['{name}']", number, finite=name not in open_)
            for name, value in answer.items()
        }

    def raw(self, observation: Mapping[str, Any], noise: Mapping[str, Array], number: int) -> Array | None:
        """Return what its network gives, before it is un-normalised; None when it has no function for that."""
        if self._raw is None:
            return None
        answer = self._call(self._raw, "raw", number, observation, **self._noise(self._raw, noise))
        return self._array(answer, "raw()", number)

    def _noise(self, function: Callable[..., Any], noise: Mapping[str, Array]) -> dict[str, Any]:
        return {"noise": {name: value.copy() for name, value in noise.items()}} if _takes(function, "noise") else {}

    def _call(
        self, function: Callable[..., Any], name: str, number: int, *arguments: Mapping[str, Any], **more: Any
    ) -> Any:
        where = f"{name}() of '{self._name}'" + (f", on observation {number}," if number >= 0 else "")
        try:
            with map_user_exceptions(where):
                return function(*(copy.deepcopy(dict(argument)) for argument in arguments), **more)
        except (VlatoolError, MemoryError):
            raise
        except Exception as error:  # the seam: user code may raise anything
            raise SourceError(
                f"{where} failed: {type(error).__name__}: {message_of(error)}.",
                "call it with that observation yourself, and correct what fails; VLATOOL_DEBUG=1 shows where",
            ) from error

    def _array(self, value: Any, what: str, number: int, *, finite: bool = True) -> Array:
        """Return an array of numbers, finite ones unless others are taken there, of a tensor as well."""
        try:
            for step in ("detach", "cpu", "numpy"):
                value = getattr(value, step)() if callable(getattr(value, step, None)) else value
            array = np.asarray(value)
        except Exception as error:  # the seam: an object may refuse in any way
            raise SourceError(
                f"{what} of '{self._name}' gives a {type(value).__name__}, which is not an array: {message_of(error)}.",
                "return a numpy array, or a tensor of float32",
            ) from error
        if array.dtype.kind not in "biuf" or not array.size:
            raise SourceError(
                f"{what} of '{self._name}' gives {_describe(value, array)}; wanted an array of numbers.",
                "return a numpy array, or a tensor of float32",
            )
        if finite and not np.isfinite(array).all():
            raise SourceError(
                f"{what} of '{self._name}' gives NaN or infinity on observation {number}.",
                "see what its code computes from that observation; actions and inputs must be finite",
            )
        return array

    def _chunk(self, answer: Any, number: int) -> Array:
        array, action = self._array(answer, "act()", number), self._spec.action
        width, most = action.robot_width, self._spec.chunk
        wide = array if array.ndim else array[None]
        if wide.shape[-1] != width or not 1 <= wide.size // width <= most:
            raise SourceError(
                f"act() of '{self._name}' gives the shape {list(array.shape)}; wanted [{most}, {width}], or fewer "
                f"leading steps, or [{width}] for the first.",
                "return the chunk in physical units, without what was planned beyond it",
            )
        return wide.astype(np.float64).reshape(-1, width)

    def _indices(self, answer: Any, number: int) -> Array:
        labels, action = self._spec.action.labels, self._spec.action
        if isinstance(answer, str):
            answer = [labels.index(answer)] if answer in labels else [answer]
        array = np.asarray(answer) if isinstance(answer, list) else self._array(answer, "act()", number)
        flat = array.reshape(-1)
        right = flat.dtype.kind in "iu" and 1 <= flat.size <= self._spec.chunk
        if not right or not ((flat >= 0) & (flat < len(labels))).all():
            raise SourceError(
                f"act() of '{self._name}' gives {_describe(answer, array)} for '{action.name}'; wanted an index from "
                f"0 to {len(labels) - 1}, or one of {', '.join(labels)}.",
                "return argmax of the logits",
            )
        return flat.astype(np.int64)


def as_fed(tensor: TensorSpec, value: Array) -> Array:
    """Return an array with the batch axis that the network's input has."""
    return value[None] if value.ndim == len(tensor.shape) - 1 else value


def _function(beside: Mapping[str, Any], name: str) -> Callable[..., Any] | None:
    function = beside.get(name)
    return function if callable(function) else None


def _takes(function: Callable[..., Any], name: str) -> bool:
    try:
        return name in inspect.signature(function).parameters
    except (TypeError, ValueError):
        return False


def _describe(value: Any, array: Array) -> str:
    if isinstance(value, Mapping):
        return f"a dict of {', '.join(map(str, value))}"[:120]
    return repr(value)[:60] if array.size <= 4 else f"an array of {array.dtype} with the shape {list(array.shape)}"
