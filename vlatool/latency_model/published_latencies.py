"""Published latencies, in the columns of the collection that the model is fitted on.

    device, power_mode, runtime, model, params_m, gflops_or_gmacs, input, precision, batch, metric, value,
    macts_m, n_layers, device_class; any others are not read

``gflops_or_gmacs`` holds 10^9 multiply-accumulates, ``params_m`` and ``macts_m`` 10^6 weights and activations.
``data/models.csv`` has more about some models (weights counted at each read); missing values follow from the other
columns; an unpredictable row is kept separately, with the reason.
"""

from __future__ import annotations

import csv
import functools
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from vlatool.errors import DataError
from vlatool.latency_model.features import ComputeUnit, Question, Work

DATA = Path(__file__).with_name("data")
REQUIRED_COLUMNS = ("device", "runtime", "model", "precision", "metric", "value", "device_class")
PRECISIONS = {
    "fp32": "float32", "float32": "float32", "fp16": "float16", "float16": "float16", "bf16": "bfloat16",
    "bfloat16": "bfloat16", "fp8": "float8", "int8": "int8", "int4": "w4", "w4": "w4", "w8": "w8",
    "fp16/int4 mix": "float16", "fp4/int4 or fp16": "w4",
}  # fmt: skip
RUNTIMES = (
    ("ncnn-vulkan", "ncnn-vulkan"), ("ncnn", "ncnn-cpu"), ("tflite", "tflite-cpu"), ("xnnpack", "tflite-cpu"),
    ("armnn", "armnn-cpu"), ("tensorrt dit_only.*backbone", "torch-cuda"), ("tensorrt", "tensorrt"),
    ("whisper_trt", "tensorrt"), ("openvino.*igpu", "openvino-igpu"), ("openvino.*npu", "openvino-npu"),
    ("openvino", "openvino-cpu"), (".*inductor cpu", "inductor-cpu"), ("torch.compile", "torch-cuda, compiled"),
    ("torch|pytorch", "torch-cuda"), ("mlc|nanollm", "mlc"), ("hailort", "hailort"), ("mnn", "mnn-cpu"),
    ("executorch", "executorch-cpu"), ("onnxruntime-(gpu|cuda)", "onnxruntime-gpu"),
    ("onnxruntime", "onnxruntime-cpu"),
)  # fmt: skip
"""Pattern of a published runtime's name with the model -> runtime that its figures count for. "dit_only" leaves the
backbone to PyTorch, and the published 127 ms are PyTorch's."""
TRAIT_NAMES = (
    ("depthwise", "mobile|shuffle|mnas|efficientnet|ghost|proxyless|blazeface|fastestdet|yolo-fastest|mixnet|fbnet"
                  "|lcnet|tinynet|edgenext|repvit|hardcore|fastvit|convnext|efficientformer|rexnet|semnas|mobilevit|convmixer"
                  "|regnetz|poolformer|efficientvit|starnet|inception_next"),
    ("attention", "vit|deit|beit|swin|bert|xcit|cait|eva|llama|gpt|clip|dino|volo|pit_|tnt|twins|coat|pvt|maxvit|gr00t"
                  "|owl|sam|mvit|nest|jx_|crossvit|gcvit|davit|caformer|flexi|lm|phi|vila|llava|whisper|halo|botnet"
                  "|lambda|bat_resnext|diffusion|stereo"),
    ("grouped", "regnet|resnext|resnest|skresnext|ecaresn|gernet|dpn"),
    ("branches", "densenet|dpn|inception|googlenet|squeeze|dla|hrnet|nasnet|yolo|ssd|shuffle|retinanet|unet"),
    ("dense", "alexnet|vgg|llama|gpt|chatglm|phi|smollm"),
)  # fmt: skip
"""Trait -> names of architectures that have it, where no graph is available."""
ROW_OF_WEIGHTS = 3000.0
"""Elements in a row of a language model's weights, where a decoding step is not described further."""


@dataclass(frozen=True)
class Point:
    """One published figure.

    Args:
        question: Question that was measured; None when it cannot be predicted.
        log_ms: Natural logarithm of the milliseconds of one item.
        group: Name of the board for hold-out: see ``DEVICE_ALIASES``.
        kind: ``device_class``: cpu, gpu, igpu, npu.
        model: Name of the model for hold-out.
    """

    question: Question | None
    log_ms: float
    group: str
    kind: str
    model: str
    why: str = ""


def read_points(path: Path) -> list[Point]:
    """Read a file of published latencies; raises DataError, with the line, when it is unreadable or malformed."""
    try:
        with path.open(encoding="utf-8", newline="") as stream:
            reader = csv.DictReader(stream)
            missing = [name for name in REQUIRED_COLUMNS if name not in (reader.fieldnames or ())]
            if missing:
                known = ", ".join(reader.fieldnames or ()) or "none"
                raise DataError(
                    f"{path} has no column '{missing[0]}'; its columns: {known[:300]}.",
                    f"add the column '{missing[0]}'; docs/concepts/latency-model.md names all of them",
                )
            rows = [
                (reader.line_num, {key: (text or "").strip() for key, text in row.items() if key}) for row in reader
            ]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DataError(
            f"{path} cannot be read: {getattr(error, 'strerror', None) or error}.",
            "check the path; it is a CSV file in UTF-8",
        ) from error
    points = [_point(row, f"{path}, line {number}") for number, row in rows]
    if not points:
        fix = f"give a CSV file with a row for each figure; columns: {', '.join(REQUIRED_COLUMNS)}"
        raise DataError(f"{path} holds no row.", fix)
    return points


def merge_versions(points: Iterable[Point]) -> list[Point]:
    """Return one point for each question: several versions of a runtime count as one figure, their mean log."""
    groups: dict[Question, list[Point]] = {}
    for point in points:
        if point.question is not None:
            groups.setdefault(point.question, []).append(point)
    return [replace(same[0], log_ms=sum(point.log_ms for point in same) / len(same)) for same in groups.values()]


def _point(row: Mapping[str, str], where: str) -> Point:
    value = _number(row.get("value", ""), where, "value")
    kind, metric = row["device_class"], row["metric"]
    if metric not in ("latency_ms", "fps", "tokens_per_s"):
        raise DataError(
            f"{where}: the metric '{metric}' is unknown; allowed: latency_ms, fps, tokens_per_s.", "write one of these"
        )
    if kind not in ("cpu", "gpu", "igpu", "npu"):
        raise DataError(
            f"{where}: the device class '{kind}' is unknown; allowed: cpu, gpu, igpu, npu.", "write one of these"
        )
    board = _name(row["device"])
    unpredictable = Point(None, math.nan, DEVICE_ALIASES.get(board, board), kind, model_family(row["model"]))
    if not (value > 0 and math.isfinite(value)):
        return replace(unpredictable, why="its value is 0, endless or missing: nothing was measured")
    unpredictable = replace(unpredictable, log_ms=math.log(value if metric == "latency_ms" else 1000 / value))
    precision = PRECISIONS.get(row["precision"])
    compute_unit = compute_unit_of(row)
    runtime = runtime_of(f"{row['runtime']} {row['model']}")
    if runs_on_cpu(row):
        unpredictable, runtime = replace(unpredictable, kind="cpu"), "ncnn-cpu"
    if precision is None:
        return replace(unpredictable, why=f"the precision '{row['precision']}' is unknown")
    if compute_unit is None:
        return replace(unpredictable, why=f"nothing is known of the device '{row['device']}' ({unpredictable.kind})")
    if not runtime:
        return replace(unpredictable, why=f"the runtime '{row['runtime']}' is unknown")
    if metric == "tokens_per_s" and precision == "int8":
        precision = "w8"
    work = work_of(row, where, decoding=metric == "tokens_per_s")
    if work is None:
        return replace(unpredictable, why="neither the row nor data/models.csv says how much it computes")
    if row.get("batch") in ("throughput", "offline"):
        runtime += ", streams"
    elif metric == "fps" and row.get("batch", "1") not in ("", "1"):
        runtime += f", batch {row['batch']}"
    return replace(unpredictable, question=Question(work, compute_unit, runtime, precision))


def runtime_of(name: str) -> str:
    """Return the runtime that a published name (and its model) counts for, empty when it is unknown."""
    return next((known for pattern, known in RUNTIMES if re.match(pattern, name.lower())), "")


def work_of(row: Mapping[str, str], where: str, *, decoding: bool) -> Work | None:
    """Return the work of a row; None when its multiply-accumulates are unknown."""
    columns = {"gflops_or_gmacs": "gmacs", "params_m": "p", "macts_m": "a", "n_layers": "l"}
    macs, weights, activations, layers = (_number(row.get(name, ""), where, short) for name, short in columns.items())
    known = _models().get(row["model"], {})
    macs, weights = known.get("gmacs", macs), known.get("params_m", weights)
    if decoding and weights > 0:  # each weight is used once
        macs, activations = weights / 1e3, weights / ROW_OF_WEIGHTS
    traits = frozenset(trait for trait, names in TRAIT_NAMES if re.search(names, row["model"].lower()))
    if decoding:
        traits = traits | {"dense", "attention"}
    if not (macs > 0 and weights > 0):
        return None
    activations = activations if activations > 0 else known.get("macts_m", math.nan)
    layers = layers if layers > 0 else known.get("layers", math.nan)
    activations = activations if activations > 0 else _estimate(ACTIVATIONS, macs, weights, traits)
    layers = layers if layers > 0 else _estimate(LAYERS, macs, weights, traits)
    return Work(macs * 1e9, weights * 1e6, activations * 1e6, layers, traits, f"{row['model']} {row.get('input', '')}")


ACTIVATIONS = (2.01, 0.86, -0.26, {"depthwise": 0.70, "attention": 0.41, "grouped": 0.14, "dense": -0.62})
LAYERS = (3.2, 0.1, 0.12, {"depthwise": 0.5, "attention": 0.5, "grouped": 0.6, "branches": 0.38, "dense": -1.0})
"""Logarithm of 10^6 activations, and of layers, by log(10^9 MACs), log(10^6 weights) and traits: least squares over the
rows that name them (activations of 1,094 models; layers of 61, a judgement for attention and grouped convolutions)."""


def _estimate(
    known: tuple[float, float, float, Mapping[str, float]], macs: float, weights: float, traits: Iterable[str]
) -> float:
    constant, by_macs, by_weights, by_trait = known
    extra = sum(by_trait.get(trait, 0.0) for trait in traits)
    return math.exp(constant + by_macs * math.log(macs) + by_weights * math.log(weights) + extra)


def _name(device: str) -> str:
    """Return a device's name without remarks, so that one device has one name."""
    return re.sub(r"\s*\(.*\)", "", re.sub(r" \(oc 2\.9ghz\)", "-2.9ghz", device.lower()))


def compute_unit_of(row: Mapping[str, str]) -> ComputeUnit | None:
    """Return the compute unit of a row; None when the device is unknown."""
    name = _name(row["device"])
    devices = known_devices()
    unit = "cpu" if runs_on_cpu(row) else row["device_class"]
    threads = re.search(r"(\d+)t\b", row["runtime"].lower())
    cluster = re.search(r"powersave=\d", row["runtime"])
    part = CLUSTERS.get(cluster[0], "") if cluster else ""
    other = "gpu" if unit == "igpu" else "igpu"
    candidates = ((f"{name} {part}", unit), (name, unit), (name, other))
    device = next((devices[candidate] for candidate in candidates if candidate in devices), None)
    if device is None:
        return None
    cores, peaks = device.cores, dict(device.peaks)
    parts = (row.get("power_mode", ""), threads and threads[0], cluster and cluster[0], row.get("batch", ""))
    setting = " ".join(part for part in parts if part)
    if threads and unit == "cpu" and int(threads[1]) < cores:
        share = int(threads[1]) / cores
        cores, peaks = float(threads[1]), {dtype: peak * share for dtype, peak in peaks.items()}
    if row.get("power_mode") == "MaxQ":
        peaks = {dtype: peak * MAX_Q for dtype, peak in peaks.items()}
    return replace(device, device=name, unit=unit, cores=cores, peaks=peaks, setting=setting)


PART_SUFFIX = re.compile(r" (end-to-end|backbone|action head|data processing)\b.*")
"""Suffix of a name for a part of the model: figures of parts are held out with it."""
SEPARATORS = re.compile(r"[\W_]+")
"""Separators, which differ between spellings of a model's name: ``resnet-50``, ``resnet50`` and ``ResNet_50``."""


def model_family(model: str) -> str:
    """Return the name that a model is held out by.

    Example:
        >>> family("LeViT_128") == family("levit-128⭐")
        True
    """
    return SEPARATORS.sub("", PART_SUFFIX.sub("", model).lower()).replace("yolov11", "yolo11")


DEVICE_ALIASES = {
    "jetson-agx-orin": "jetson-agx-orin-64gb", "jetson-orin-nano-8gb-super": "jetson-orin-nano-8gb",
    "raspberry-pi-5-2.9ghz": "raspberry-pi-5",
}  # fmt: skip
"""Name -> the same board, overclocked, in another power mode, or under another name: held out together."""
CLUSTERS = {"powersave=1": "little", "powersave=2": "big"}
"""ncnn's ``powersave`` -> cores in use of a processor with two kinds (ncnn, ``set_cpu_powersave``)."""


def runs_on_cpu(row: Mapping[str, str]) -> bool:
    """Return whether a figure of a GPU is really one of the CPU.

    ncnn has no Vulkan kernels for int8: the layers run on the CPU, and the published figures of both are equal
    (ResNet-50 with one thread: 107.0 and 106.8 ms on AGX Orin, 374.8 and 370.6 on AGX Xavier, 516 and 517 on Nano).
    """
    return row["runtime"].lower().startswith("ncnn-vulkan") and row["precision"] == "int8"


MAX_Q = 0.5
"""Share of the peak in MLPerf's MaxQ on AGX Orin (throughput fell to 0.49-0.61 of MaxP)."""


@functools.cache
def known_devices() -> dict[tuple[str, str], ComputeUnit]:
    """Return (name, unit) -> compute unit of each device in ``data/devices.csv``."""
    devices = {}
    for row in _table("devices.csv"):
        peaks = {dtype: float(row[dtype]) for dtype in ("float32", "float16", "int8") if row[dtype]}
        devices[row["device"].lower(), row["unit"]] = ComputeUnit(
            row["device"].lower(), row["unit"], float(row["cores"]), float(row["clock_ghz"]), peaks,
            float(row["bandwidth_gb_s"]), isa=row["isa"],
        )  # fmt: skip
    return devices


@functools.cache
def published_devices() -> dict[tuple[str, str], str]:
    """Return (profile, unit) -> name of the device in published figures."""
    return {
        (profile, row["unit"]): row["device"].lower()
        for row in _table("devices.csv")
        for profile in row["profile"].split(";")
        if profile
    }


@functools.cache
def _models() -> dict[str, dict[str, float]]:
    numbers = ("gmacs", "params_m", "macts_m", "layers")
    return {row["model"]: {key: float(row[key]) for key in numbers if row[key]} for row in _table("models.csv")}


def _table(name: str) -> list[dict[str, str]]:
    with (DATA / name).open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def _number(text: str, where: str, column: str) -> float:
    if not text:
        return math.nan
    try:
        return float(text)
    except ValueError:
        raise DataError(
            f"{where}: '{text}' in the column '{column}' is not a number.",
            "write a number with a point, such as 12.5, or leave the cell empty where it may be",
        ) from None
