"""Each configuration of the other tools: how its model file is made (once) and how it is opened.

Libraries are imported inside the functions, so that each worker process holds only its own.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from _workload import SEED, Array, Feeds, Infer, Workload, fresh

SAMPLES = 48


@dataclass(frozen=True)
class Peer:
    """One configuration of another tool.

    Args:
        open: Workload, model file -> function of one inference.
        file: Name of the model file below ``peers/``; the float32 graph when empty.
        make: Workload, directory -> writes ``model`` files there.
    """

    open: Callable[[Workload, Path], Infer]
    folder: str = ""
    file: str = ""
    make: Callable[[Workload, Path], None] | None = None

    def model(self, workload: Workload) -> Path:
        """Return the file that is opened."""
        return workload.folder / "peers" / self.folder / self.file if self.make else workload.model

    def built(self, workload: Workload) -> bool:
        """Say whether the model is there."""
        return self.model(workload).is_file()

    def prepare(self, workload: Workload) -> None:
        """Make the model unless it is there."""
        if self.make is None or self.built(workload):
            return
        with fresh(workload.folder / "peers" / self.folder) as draft:
            draft.mkdir()
            self.make(workload, draft)


# ONNX Runtime ---------------------------------------------------------------------------------------------------------


def open_ort(_workload: Workload, model: Path) -> Infer:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(str(model), options, providers=["CPUExecutionProvider"])

    def infer(feeds: Feeds) -> Array:
        found: Array = session.run(None, feeds)[0]
        return found

    return infer


def save_onnx(model: Any, path: Path) -> None:
    import onnx

    large = model.ByteSize() > 1_500_000_000
    onnx.save(model, str(path), save_as_external_data=large, location=path.name + ".data")


def prepared_for_ort(workload: Workload, folder: Path) -> Path:
    """Copy the graph without the recorded shapes that ONNX Runtime's quantizer trips over (see the reference)."""
    import onnx

    model = onnx.load(str(workload.model))
    del model.graph.value_info[:]
    path = folder / "prepared.onnx"
    save_onnx(model, path)
    return path


def make_dynamic(ops: list[str] | None) -> Callable[[Workload, Path], None]:
    def make(workload: Workload, folder: Path) -> None:
        from onnxruntime.quantization import QuantType, quantize_dynamic

        source = prepared_for_ort(workload, folder)
        quantize_dynamic(
            source, folder / "model.onnx", per_channel=True, weight_type=QuantType.QInt8, op_types_to_quantize=ops
        )
        source.unlink()

    return make


def make_static(ops: list[str] | None) -> Callable[[Workload, Path], None]:
    """U8S8, QDQ, per channel, min-max: what ONNX Runtime's documentation advises for x86 processors."""

    def make(workload: Workload, folder: Path) -> None:
        from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static
        from onnxruntime.quantization.shape_inference import quant_pre_process

        class Reader(CalibrationDataReader):  # type: ignore[misc]
            def __init__(self) -> None:
                self.rows: Iterator[Feeds] = iter(workload.feeds("calibration")[:SAMPLES])

            def get_next(self) -> Feeds | None:
                return next(self.rows, None)

        source, simple = prepared_for_ort(workload, folder), folder / "simple.onnx"
        quant_pre_process(str(source), str(simple), skip_symbolic_shape=True)
        quantize_static(
            simple,
            folder / "model.onnx",
            Reader(),
            quant_format=QuantFormat.QDQ,
            per_channel=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            op_types_to_quantize=ops,
        )
        source.unlink()
        simple.unlink()

    return make


# OpenVINO and NNCF ----------------------------------------------------------------------------------------------------


def open_openvino(precision: str, **settings: Any) -> Callable[[Workload, Path], Infer]:
    def opened(_workload: Workload, model: Path) -> Infer:
        import openvino

        core = openvino.Core()
        wanted = {
            "INFERENCE_PRECISION_HINT": precision,
            "INFERENCE_NUM_THREADS": 1,
            "NUM_STREAMS": 1,
            "PERFORMANCE_HINT": "LATENCY",
            "ENABLE_CPU_PINNING": False,
            **settings,
        }
        compiled = core.compile_model(core.read_model(str(model)), "CPU", wanted)
        got = compiled.get_property("INFERENCE_PRECISION_HINT").get_type_name()
        if got != precision:
            raise RuntimeError(f"this processor computes in {got}, not in {precision}")
        request, output = compiled.create_infer_request(), compiled.outputs[0]

        def infer(feeds: Feeds) -> Array:
            found: Array = request.infer(feeds, share_inputs=True)[output]
            return found

        return infer

    return opened


def make_nncf(transformer: bool) -> Callable[[Workload, Path], None]:
    def make(workload: Workload, folder: Path) -> None:
        import nncf
        import openvino

        options: dict[str, Any] = {}
        if transformer:
            off = nncf.AdvancedSmoothQuantParameters(convolution=-1, matmul=-1)
            options["model_type"] = nncf.ModelType.TRANSFORMER
            options["advanced_parameters"] = nncf.AdvancedQuantizationParameters(smooth_quant_alphas=off)
        data = nncf.Dataset(workload.feeds("calibration")[:SAMPLES])
        model = openvino.Core().read_model(str(workload.model))
        quantized = nncf.quantize(model, data, subset_size=SAMPLES, **options)
        openvino.save_model(quantized, folder / "model.xml", compress_to_fp16=False)

    return make


def make_nncf_weights(workload: Workload, folder: Path) -> None:
    import nncf
    import openvino

    model = nncf.compress_weights(openvino.Core().read_model(str(workload.model)))
    openvino.save_model(model, folder / "model.xml", compress_to_fp16=False)


# torch ----------------------------------------------------------------------------------------------------------------


def open_torch(
    *, bfloat16: bool = False, compiled: bool = False, quantized: bool = False
) -> Callable[[Workload, Path], Infer]:
    """The sample's module; ``bfloat16`` is autocast, ``compiled`` is torch.compile with frozen weights."""

    def opened(workload: Workload, _model: Path) -> Infer:
        os.environ.setdefault("TORCHINDUCTOR_CACHE_DIR", str(workload.folder / "inductor"))
        import torch

        from vlatool import registry

        torch.set_num_threads(1)
        module = registry.module("samples", workload.name).make(seed=SEED)
        if quantized:
            from torchao.quantization import Int8DynamicActivationInt8WeightConfig, quantize_

            quantize_(module, Int8DynamicActivationInt8WeightConfig())
        if compiled:
            import torch._inductor.config

            torch._inductor.config.freezing = True
            module = torch.compile(module, dynamic=False)

        def infer(feeds: Feeds) -> Array:
            with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
                found = module(*(torch.from_numpy(array) for array in feeds.values()))
            array: Array = found.float().numpy()
            return array

        return infer

    return opened


REFERENCE = "ort:fp32"
LAYERS = ["MatMul", "Gemm", "Conv"]
FLOAT, HALF = open_openvino("f32"), open_openvino("bf16")


def _nncf(kind: str, opened: Callable[[Workload, Path], Infer], transformer: bool) -> Peer:
    return Peer(opened, f"nncf-{kind}", "model.xml", make_nncf(transformer))


PEERS = {
    REFERENCE: Peer(open_ort),
    "nncf:int8 (bf16)": _nncf("default", HALF, False),
    "nncf:int8 (f32)": _nncf("default", FLOAT, False),
    "nncf:int8 transformer, no SmoothQuant (bf16)": _nncf("transformer", HALF, True),
    "nncf:int8 transformer, no SmoothQuant (f32)": _nncf("transformer", FLOAT, True),
    "torch:compile bf16 autocast": Peer(open_torch(bfloat16=True, compiled=True)),
    "openvino:bf16": Peer(HALF),
    "nncf:int8 weights + dynamic quantization (bf16)": Peer(
        open_openvino("bf16", DYNAMIC_QUANTIZATION_GROUP_SIZE=32), "nncf-weights", "model.xml", make_nncf_weights
    ),
    "ort:dynamic": Peer(open_ort, "ort-dynamic", "model.onnx", make_dynamic(None)),
    "ort:dynamic MatMul": Peer(open_ort, "ort-dynamic-matmul", "model.onnx", make_dynamic(["MatMul"])),
    "ort:static U8S8": Peer(open_ort, "ort-static", "model.onnx", make_static(None)),
    "ort:static U8S8 MatMul/Gemm/Conv": Peer(open_ort, "ort-static-layers", "model.onnx", make_static(LAYERS)),
    "torch:bf16 autocast": Peer(open_torch(bfloat16=True)),
    "torchao:int8 dynamic": Peer(open_torch(quantized=True)),
    "torchao:int8 dynamic, compile": Peer(open_torch(quantized=True, compiled=True)),
    "openvino:f32": Peer(FLOAT),
    "torch:fp32": Peer(open_torch()),
}
