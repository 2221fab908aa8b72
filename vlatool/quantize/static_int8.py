"""Static int8: weights and activation ranges ahead of time, in QDQ form."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from vlatool.bundle import Bundle
from vlatool.data import recorded_observations
from vlatool.errors import DataError, RecipeError, nearest
from vlatool.quantize._graphs import QUANTIZED_OPS, Quantization, load, quantization_library, quiet_quantizer, save
from vlatool.quantize._integer_matmul import use_integer_matmul
from vlatool.runtime.policy import Policy
from vlatool.runtime.program import Program
from vlatool.stage import Context, source_of

if TYPE_CHECKING:
    from vlatool.profile import Profile

METHODS = {"minmax": "MinMax", "entropy": "Entropy", "percentile": "Percentile"}


class StaticInt8(Quantization):
    """Quantize MatMul, Gemm and Conv to int8 with activation ranges from calibration data (QDQ form).

    The default layout is uint8 activations with symmetric int8 weights, which x86 VNNI computes fastest; ``int8``
    activations are what TensorRT and ARM take.
    """

    packages: ClassVar[tuple[str, ...]] = ("onnx", "onnxruntime", "numpy")

    calibration: Path | None = Field(None, description="recorded observations; the bundle's own when not given")
    samples: int = Field(64, ge=1, description="calibration samples, spread over the recording")
    method: Literal["minmax", "entropy", "percentile"] = Field("minmax", description="how activation ranges are chosen")
    percentile: float = Field(99.99, gt=50, le=100, description="for the method percentile")
    activations: Literal["uint8", "int8"] = Field("uint8", description="activation type")
    per_channel: bool = Field(True, description="one weight scale for each output channel")
    reduce_range: bool = Field(False, description="7-bit weights, for x86 processors without VNNI")
    layout: Literal["ort", "qdq"] = Field(
        "ort",
        description="ort: ONNX Runtime's integer MatMul; qdq: standard operators alone, for TensorRT and OpenVINO",
    )
    quantize_outputs: bool = Field(False, description="also quantize the outputs of MatMul and Gemm")
    attention: bool = Field(False, description="also quantize the products inside attention (of two activations)")
    ops: tuple[str, ...] = Field(QUANTIZED_OPS, description="operator types to quantize")

    def inputs(self) -> tuple[Path, ...]:
        """The calibration file."""
        return (self.calibration,) if self.calibration else ()

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """The operators are ones that can be quantized, and there is calibration data."""
        super().check(source, profile)
        for name in self.ops:
            if name not in QUANTIZED_OPS:
                raise RecipeError(f"The operator '{name}' cannot be quantized; {nearest(name, QUANTIZED_OPS)}.")
        if source is not None and not recorded_observations(source, 1, self.calibration):
            raise DataError(
                f"{source.path} carries no calibration data, which {self.name()} needs.",
                "pass --calibration FILE.npz, or use quantize.dynamic_int8, which needs none",
            )

    def run(self, source: Bundle | None, out: Path, context: Context) -> Bundle:
        """Calibrate and quantize every selected graph."""
        bundle = source_of(source, self.name())
        self.check(bundle, None)
        context.tell("recording calibration inputs", None)
        observations = recorded_observations(bundle, self.samples, self.calibration)
        feeds = record_feeds(bundle, observations)

        def quantize(name: str, original: Path, target: Path) -> None:
            self._quantize(original, target, feeds[name])

        return self.transform(bundle, out, context, quantize)

    def _quantize(self, original: Path, target: Path, feeds: list[dict[str, Any]]) -> None:
        quantization = quantization_library()
        model = load(original)
        excluded = self.excluded_nodes(model, self.ops, attention=self.attention)
        activation = quantization.QuantType.QUInt8 if self.activations == "uint8" else quantization.QuantType.QInt8
        with quiet_quantizer() as scratch:
            quantization.quantize_static(
                model,
                scratch / "model.onnx",
                _FeedReader(feeds),
                quant_format=quantization.QuantFormat.QDQ,
                op_types_to_quantize=list(self.ops),
                per_channel=self.per_channel,
                reduce_range=self.reduce_range,
                activation_type=activation,
                weight_type=quantization.QuantType.QInt8,
                nodes_to_exclude=excluded,
                calibrate_method=quantization.CalibrationMethod[METHODS[self.method]],
                extra_options=self._extra_options(),
            )
            quantized = load(scratch / "model.onnx")
        if self.layout == "ort":
            use_integer_matmul(quantized)
        save(quantized, target)

    def _extra_options(self) -> dict[str, Any]:
        options: dict[str, Any] = {
            "WeightSymmetric": True,
            "ActivationSymmetric": self.activations == "int8",
        }
        if self.method == "percentile":
            options["CalibPercentile"] = self.percentile
        if not self.quantize_outputs:
            options["OpTypesToExcludeOutputQuantization"] = ["MatMul", "Gemm"]
        return options


class _FeedReader:
    """Hands recorded feeds to ONNX Runtime's calibrators."""

    def __init__(self, feeds: list[dict[str, Any]]) -> None:
        self._feeds: Iterator[dict[str, Any]] = iter(feeds)

    def get_next(self) -> dict[str, Any] | None:
        """Return the next feeds, None at the end."""
        return next(self._feeds, None)


class _RecordingSession:
    """A session that remembers what it was fed."""

    def __init__(self, session: Any) -> None:
        self.session = session
        self.feeds: list[dict[str, Any]] = []

    def run(self, feeds: Mapping[str, Any]) -> Mapping[str, Any]:
        """Remember the feeds and run."""
        self.feeds.append({name: np.array(value) for name, value in feeds.items()})
        given: Mapping[str, Any] = self.session.run(feeds)
        return given


def record_feeds(bundle: Bundle, observations: list[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """Run the policy on observations and return what each of its graphs was fed: graph name -> list of feeds."""
    policy = Policy.open(bundle, threads=1, seed=0)
    recorders = {name: _RecordingSession(session) for name, session in policy.program.sessions.items()}
    policy.program = Program(policy.program.steps, recorders, seed=0)
    for observation in observations:
        policy.infer(observation)
    return {name: recorder.feeds for name, recorder in recorders.items()}
