"""An observation as the controller has it -> the arrays that the graphs take."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import DataError
from vlatool.files.printable import amount
from vlatool.runtime.assets import Assets, asset_path
from vlatool.runtime.converter import Converter, newest_moment
from vlatool.runtime.history import History
from vlatool.runtime.statistics import load_normaliser
from vlatool.runtime.tokenizer import Tokenizer, tokenizer_content

if TYPE_CHECKING:
    from vlatool.runtime.image import FrameEncoder

MAX_SMALL_VALUES = 256
NOT_FINITE = (
    "check where it comes from: a sensor, a recording, an environment; a policy that handles such values is exported "
    "with finite: false in its spec"
)
Array = NDArray[Any]
Encoder = Callable[..., Array]
"""Takes the value of an input, and for a prompt the state that it has in it, encoded."""


class EncodedObservation(dict[str, Array]):
    """An observation as the graphs take it, name -> (1, ...): normalised, text as ids. ``infer`` takes it as it is."""

    state: Array | None = None
    """(S,) what the action is relative to, in the units of the robot, where the spec says so."""


class ObservationEncoder:
    """Checks an observation against the spec, normalises it, turns frames into pictures of the network, text into ids.

    Args:
        assets: Directory of statistics and tokenizers, or the bundle that has them.
        history: Earlier moments of inputs that hold several, which may then be given as one moment; without it, they
            are given whole.
        inputs: Inputs that it encodes, with what their prompts have in them; all when None.

    Raises:
        SpecError: when statistics or a tokenizer are missing or do not fit.
    """

    def __init__(
        self,
        spec: PolicySpec,
        assets: Assets,
        history: History | None = None,
        inputs: Collection[str] | None = None,
    ) -> None:
        encoded = _with_prompts(spec, inputs)
        self.names = [tensor.name for tensor in encoded]
        states = [tensor.name_in_prompt for tensor in spec.inputs]
        encoders = [
            (tensor.name, _encoder(tensor, assets, history, exact=tensor.name in states), tensor.name_in_prompt)
            for tensor in encoded
        ]
        self._encoders = sorted(encoders, key=lambda each: bool(each[2]))  # what a prompt has stands before it
        self._dtypes = {tensor.name: tensor.dtype for tensor in spec.inputs}
        reference = spec.reference
        self._reference = reference if reference is not None and reference.name in self.names else None
        self._of_reference = Converter(self._reference, assets) if self._reference else None

    def __call__(self, observation: Mapping[str, Any]) -> EncodedObservation:
        """Return one array with a batch axis for each input of the spec; those of an encoded observation as they are.

        Args:
            observation: Input name -> value in physical units, with or without the batch axis of 1; text as ``str``;
                a raw frame, uint8 (H, W, C) or (H, W), for an input with an ``image``.

        Raises:
            DataError: when an input is missing or has another shape or dtype, or holds what its dtype cannot hold, or
                NaN or infinity where its spec does not say ``finite: false``.
        """
        if isinstance(observation, EncodedObservation):
            return self._copied(observation)
        values = EncodedObservation()
        with np.errstate(over="raise"):
            for name, encode, state in self._encoders:
                try:
                    value = observation[name]
                except Exception:  # the seam: a mapping raises KeyError, anything else may raise anything
                    raise self._missing_input(observation, name) from None
                try:
                    values[name] = encode(value, values[state]) if state else encode(value)
                except (RuntimeWarning, FloatingPointError):
                    raise self._too_large(name, value) from None
        if self._reference is not None:
            values.state = newest_moment(observation[self._reference.name], self._reference.robot_width)
        return values

    def _copied(self, encoded: EncodedObservation) -> EncodedObservation:
        """Return an encoded observation, with the state that the action is relative to."""
        values = EncodedObservation(encoded)
        values.state = encoded.state
        if values.state is None and self._reference is not None and self._of_reference is not None:
            robot = self._of_reference.to_robot(np.asarray(encoded[self._reference.name], np.float32))
            values.state = newest_moment(robot, self._reference.robot_width)
        return values

    def _too_large(self, name: str, value: Any) -> DataError:
        """Return the error for finite values that the dtype cannot hold, as they are or once they are normalised."""
        dtype, sizes = self._dtypes[name], np.abs(np.asarray(value, np.float64))
        largest = sizes[np.isfinite(sizes)].max(initial=0)
        limit = f" (beyond {np.finfo(dtype).max:.2g})" if np.dtype(dtype).kind == "f" else ""
        return DataError(
            f"The input '{name}' has values that are too large for {dtype}{limit}, as they are or normalised: up to "
            f"{largest:.3g}.",
            "check where it comes from, and its unit",
        )

    def _missing_input(self, observation: Any, name: str) -> DataError:
        takes = f"the policy takes {', '.join(self.names)}."
        if not isinstance(observation, Mapping):
            return DataError(
                f"The observation is a {type(observation).__name__}; it must be a mapping of names to values: {takes}",
                self._example(),
            )
        has = ", ".join(map(str, observation)) or "nothing"
        return DataError(f"The observation has no '{name}' (it has: {has}); {takes}", self._example())

    def _example(self) -> str:
        """Return how an observation is written."""
        written = ", ".join(f'"{name}": ...' for name in self.names)
        only = "the policy has one input: " if len(self.names) == 1 else ""
        return f"{only}pass {{{written}}}"


def _with_prompts(spec: PolicySpec, inputs: Collection[str] | None) -> list[TensorSpec]:
    """Return the inputs of these names, and those that are written into their prompts."""
    if inputs is None:
        return list(spec.inputs)
    wanted = {*inputs, *(tensor.name_in_prompt for tensor in spec.inputs if tensor.name in inputs)}
    return [tensor for tensor in spec.inputs if tensor.name in wanted]


def _encoder(tensor: TensorSpec, assets: Assets, history: History | None = None, *, exact: bool = False) -> Encoder:
    """Return the encoder of an input.

    Args:
        exact: whether a vector is normalised in float32 throughout, as in training: the bins of a prompt show a bit.
    """
    if tensor.kind == "text":
        return _text_encoder(tensor, assets)
    if tensor.history and history is not None:
        return _moment_encoder(tensor, assets, history)
    if tensor.image is not None:
        from vlatool.runtime.image import FrameEncoder  # for a robot whose policy takes frames

        return _frame_encoder(tensor, FrameEncoder(tensor.moment, tensor.image))
    if tensor.convert:
        return _converting_encoder(tensor, assets)
    dtype = np.dtype(tensor.dtype)
    normaliser = load_normaliser(tensor, assets)
    checked = dtype.kind == "f" and tensor.finite
    batched, single = tensor.shape, tensor.shape[1:]
    vector = (
        normaliser is not None
        and not exact
        and len(single) == 1
        and tensor.width in range(1, MAX_SMALL_VALUES)
        and dtype == np.float32
    )

    def encode(value: Any) -> Array:
        array = value if isinstance(value, np.ndarray) else _as_array(value, tensor)
        if array.dtype != dtype:
            array = _cast(array, dtype, tensor)
        shape = array.shape
        if vector and shape == single:
            values = array.tolist()
            if normaliser is not None and math.isfinite(sum(values)):
                return normaliser.forward_row(values)
        if shape != batched:
            array = array[None] if shape == single else _batched(array, tensor)
        if checked and not all_finite(array):
            raise DataError(f"The input '{tensor.name}' holds {_not_finite(array)}.", NOT_FINITE)
        if normaliser is None:
            return array
        normalised = normaliser.forward(array)
        return normalised if normalised.dtype == dtype else normalised.astype(dtype)

    return encode


def _converting_encoder(tensor: TensorSpec, assets: Assets) -> Encoder:
    """Return an encoder of the robot's values, which are checked before they are converted; float16 in float32."""
    wide = "float32" if tensor.dtype == "float16" else tensor.dtype
    checked, converter = _encoder(replace(tensor.observation, dtype=wide), assets), Converter(tensor, assets)

    def encode(value: Any) -> Array:
        converted = converter.to_network(checked(value))
        if not all_finite(converted):
            raise DataError(
                f"The input '{tensor.name}' holds {_not_finite(converted)} once it is converted.",
                "check where it comes from: a quaternion of zeros is not a rotation",
            )
        return converted.astype(tensor.dtype, copy=False)

    return encode


def _as_array(value: Any, tensor: TensorSpec) -> Array:
    try:
        return np.asarray(value)
    except ValueError as error:
        raise DataError(
            f"The input '{tensor.name}' is not an array: its rows have different lengths.", "give rows of one length"
        ) from error
    except Exception as error:  # the seam: numpy asks the object for an array, a tensor on a GPU has none
        raise DataError(
            f"The input '{tensor.name}' is a {type(value).__name__}, which cannot be converted to a numpy array.",
            "pass numpy arrays; tensors as tensor.detach().cpu().numpy()",
        ) from error


def _frame_encoder(tensor: TensorSpec, encode_frame: FrameEncoder) -> Encoder:
    """Return an encoder of one frame, or of those of all moments where the input has a history."""

    def encode(value: Any) -> Array:
        frame = value if isinstance(value, np.ndarray) else _as_array(value, tensor)
        if not tensor.history:
            return encode_frame(frame)
        frames = frame[0] if len(frame) == 1 and frame.ndim > len(tensor.observation.shape) - 1 else frame
        if len(frames) != tensor.history:
            raise DataError(
                f"The input '{tensor.name}' is given as {amount(len(frames), 'frame')}; the policy takes "
                f"{tensor.history}.",
                "give the frame of this moment alone, or those of all moments",
            )
        return np.stack([encode_frame(each) for each in frames], axis=1)

    return encode


def _moment_encoder(tensor: TensorSpec, assets: Assets, history: History) -> Encoder:
    """Return an encoder of one moment, to which those before it are added, or of all moments at once."""
    whole, moment = _encoder(tensor, assets), _encoder(tensor.moment, assets)

    axes = len(tensor.observation.shape)

    def encode(value: Any) -> Array:
        shape = _shape(value)
        if tensor.frame == "grey" and len(shape) > 2 and shape[-1] == 1:
            shape = shape[:-1]  # a grey frame may be (H, W, 1)
        if len(shape) == axes or (len(shape) == axes - 1 and shape[0] != 1):
            return whole(value)
        return history.window(tensor.name, moment(value))

    return encode


def _shape(value: Any) -> tuple[int, ...]:
    """Return the shape of what may become an array; none of what may not, which its encoder refuses."""
    try:
        return tuple(value.shape) if hasattr(value, "shape") else np.shape(value)
    except Exception:  # the seam: numpy asks the object for an array
        return ()


def _text_encoder(tensor: TensorSpec, assets: Assets) -> Encoder:
    content = tokenizer_content(assets, tensor.tokenizer, tensor.name)
    tokenizer = Tokenizer(asset_path(assets, tensor.tokenizer), tensor.max_tokens, tensor.name, content, tensor.prompt)

    def encode(value: Any, state: Array | None = None) -> Array:
        if isinstance(value, str):
            return tokenizer(value, state)
        if isinstance(value, np.ndarray) and value.dtype.kind == "U" and value.size == 1:
            return tokenizer(str(value.reshape(())), state)
        raise DataError(f"The input '{tensor.name}' is text; got {type(value).__name__}.", "pass a str")

    return encode


def _cast(array: Array, dtype: np.dtype[Any], tensor: TensorSpec) -> Array:
    """Widen within a kind (int32 -> int64, float64 -> float32), refuse everything that changes what values mean."""
    integers = array.dtype.kind in "iu" and dtype.kind in "iu" and np.can_cast(array.dtype, dtype)
    to_float = dtype.kind == "f" and array.dtype.kind in "iuf" and dtype != np.uint8
    if not (integers or to_float):
        hint = "raw pixel values from 0 to 255 as uint8" if tensor.dtype == "uint8" else f"cast it to {tensor.dtype}"
        raise DataError(f"The input '{tensor.name}' is {array.dtype}; the policy takes {tensor.dtype}.", hint)
    return array.astype(dtype)


def _batched(array: Array, tensor: TensorSpec) -> Array:
    if not tensor.shape and array.shape == (1,):
        return array.reshape(())
    if array.ndim == len(tensor.shape) - 1:
        array = array[None]
    fits = array.ndim == len(tensor.shape) and all(
        isinstance(want, str) or want == got for want, got in zip(tensor.shape, array.shape, strict=True)
    )
    if not fits:
        raise DataError(
            f"The input '{tensor.name}' has the shape {list(array.shape)}; the policy takes {list(tensor.shape)} "
            "(the first axis may be left out).",
            f"give it as {list(tensor.shape[1:])} or {list(tensor.shape)}",
        )
    return array


def all_finite(array: Array) -> bool:
    """Return whether no element is NaN or infinite.

    Few elements are summed without numpy: right after an inference, whose weights have filled the processor's caches,
    that takes half as long as a numpy reduction (``vlatool benchmark overhead``).
    """
    if array.size <= MAX_SMALL_VALUES and math.isfinite(sum(array.ravel().tolist())):  # that of float64 can overflow
        return True
    return bool(np.isfinite(array).all())


def _not_finite(array: Array) -> str:
    nans = int(np.isnan(array).sum())
    return (
        f"{nans} NaN of {amount(array.size, 'value')}"
        if nans
        else f"infinity in {int(np.isinf(array).sum())} of {array.size}"
    )


def not_finite_text(spec: PolicySpec, observation: Mapping[str, Any]) -> str:
    """Return what an observation holds beside finite values, in words; nothing where it holds none.

    Example:
        >>> spec = PolicySpec((TensorSpec("x", (1, 4), finite=False),), (TensorSpec("y", (1, 1)),), 10)
        >>> not_finite_text(spec, {"x": [1, math.nan, math.inf, math.nan]})
        "2 NaN and 1 inf in the 4 values of 'x'"
    """
    return " and ".join(_texts(spec, observation))


def _texts(spec: PolicySpec, observation: Mapping[str, Any]) -> Iterator[str]:
    for tensor in (each for each in spec.inputs if not each.finite):
        array = np.asarray(observation[tensor.name], np.float64)
        counts = {"NaN": np.isnan(array).sum(), "inf": (array == math.inf).sum(), "-inf": (array == -math.inf).sum()}
        parts = [f"{count} {name}" for name, count in counts.items() if count]
        if parts:
            yield f"{' and '.join(parts)} in the {amount(array.size, 'value')} of '{tensor.name}'"
