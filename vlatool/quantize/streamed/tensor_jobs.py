"""From the stored bytes of one tensor to the bytes of its record, a few megabytes at a time."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import GraphError
from vlatool.quantize.streamed._block_quantization import (
    METHODS,
    Choose,
    Format,
    Scratch,
    dequantize,
    pack_zeros,
    planes_of,
    planes_of_rows,
    quantize_planes,
    unpack,
    unpack_zeros,
)
from vlatool.quantize.streamed._graph_rewrite import PART_BYTES, Piece, Task, stores_zeros
from vlatool.quantize.streamed.records import Record, Tools, padded
from vlatool.weights.shards import FLOATS, StoredTensor

Array = NDArray[Any]
READ_BYTES = 1 << 22
COMPUTED = 1 << 17
"""Elements that are computed at once: what fits into a core's cache."""
OUT_BYTES = {"F32": 4, "F16": 2}


@dataclass(frozen=True)
class Job:
    """What a worker does for one record; made of plain values, so that it can be sent to another process.

    Args:
        task: What becomes of a tensor.
        form: Of quantized weights.
        choose: Name in ``METHODS``: how scales and zero points are found.
        tolerance: Largest relative L2 error of a quantized weight.
        first, count: Elements of a tensor that is kept.
    """

    task: Task
    form: Format
    choose: str
    tolerance: float
    first: int = 0
    count: int = 0

    def __call__(self, tools: Tools, data: Array) -> dict[str, Any]:
        """Fill the zeroed bytes of the record and return its figures."""
        if self.task.kind == "copy":
            return copy_tensor(self.task, self.first, self.count, tools, data)
        return quantize_tensor(self.task, self.form, METHODS[self.choose], self.tolerance, tools, data)

    def to_json(self) -> str:
        """Return one line that ``from_json`` turns back; a tensor in memory cannot be sent."""
        return json.dumps(asdict(self), default=str)

    @classmethod
    def from_json(cls, line: str) -> Job:
        """Build a job from its line."""
        fields = json.loads(line)
        task, form = fields.pop("task"), Format(**fields.pop("form"))
        source = task["source"] | {"file": Path(task["source"]["file"]), "shape": tuple(task["source"]["shape"])}
        pieces = tuple(Piece(**{**entry, "shape": tuple(entry["shape"])}) for entry in task["pieces"])
        return cls(Task(**{**task, "source": StoredTensor(**source), "pieces": pieces}), form, **fields)


def records_of(task: Task, form: Format, choose: str, tolerance: float) -> list[Record]:
    """Return the records of a task, one after the other in the file; a tensor that is kept is cut into several."""
    source = task.source
    if task.kind != "copy":
        job = Job(task, form, choose, tolerance)
        return [Record(task.label, padded(task.size), job, source.count, source.array is None)]
    width = OUT_BYTES.get(task.dtype) or source.item_bytes
    step, records = PART_BYTES // width, []
    for first in range(0, max(source.count, 1), step):
        count = min(step, source.count - first)
        job = Job(task, form, choose, tolerance, first, count)
        records.append(Record(task.label, padded(count * width), job, count, source.array is None, "copied"))
    return records


def quantize_tensor(
    task: Task, form: Format, choose: Choose, tolerance: float, tools: Tools, data: Array
) -> dict[str, Any]:
    """Quantize one weight into its record and return its figures.

    Raises:
        GraphError: when a weight is not finite, or the error is beyond what the bits allow.
    """
    shape = (task.columns, -(-task.rows // form.block))
    stored = piece(task, 0, data) if task.kind == "blocks" else np.empty((*shape, form.bytes), np.uint8)
    stored = stored.reshape(-1, form.bytes)
    scale, zero = tools.scratch("scale", shape), tools.scratch("zero", shape, np.uint8)
    digest = hashlib.sha256()
    lost = norm = 0.0
    for planes, blocks in _planes(task, form, tools, digest):
        quantized = quantize_planes(planes, form, choose, tools.scratch, stored[blocks])
        check_finite(quantized.squared_norm, task.source)
        scale.reshape(-1)[blocks], zero.reshape(-1)[blocks] = quantized.scale, quantized.zero
        lost += quantized.squared_error
        norm += quantized.squared_norm
    store(task, form, stored, scale, zero, data)
    return {**figures(task, lost, norm, tolerance), "sha256": digest.hexdigest()}


def figures(task: Task, lost: float, norm: float, tolerance: float) -> dict[str, Any]:
    """Return name, shape, relative error of a quantized weight; refuse an error beyond ``tolerance``."""
    source, error = task.source, math.sqrt(lost / norm) if norm else 0.0
    if not error <= tolerance:
        raise GraphError(
            f"Quantizing '{source.name}' ({source.file.name}) loses {error:.3g} of its norm; allowed: {tolerance:.3g}.",
            "exclude the layer, or use more bits or smaller blocks",
        )
    return {"layer": task.label, "tensor": source.name, "shape": list(source.shape), "error": error}


def check_finite(squared_norm: float, source: StoredTensor) -> None:
    """Refuse weights that hold NaN or infinity."""
    if not math.isfinite(squared_norm):
        raise GraphError(
            f"The weight '{source.name}' in {source.file.name} holds NaN or infinity.",
            "train or download it again; a policy with such a weight gives no finite action",
        )


def piece(task: Task, number: int, data: Array) -> Array:
    """Return the bytes of one tensor of a record."""
    place = task.pieces[number]
    return data[place.offset : place.offset + place.size]


def store(task: Task, form: Format, stored: Array, scale: Array, zero: Array, data: Array) -> None:
    """Write scales and zero points, (columns, blocks) each, and, for QDQ, the codes in that layout."""
    if task.kind == "blocks":
        piece(task, 1, data)[:] = scale.reshape(-1).view(np.uint8)
        if not form.symmetric:
            piece(task, 2, data)[:] = pack_zeros(zero, form).reshape(-1)
        return
    planes = unpack(stored.reshape(-1, form.bytes), form, Scratch())
    half = form.block // 2
    rows = np.empty((zero.shape[1], form.block, zero.shape[0]), np.uint8)
    shaped = planes.reshape(form.block, *zero.shape)
    rows[:, 0::2], rows[:, 1::2] = shaped[:half].transpose(2, 0, 1), shaped[half:].transpose(2, 0, 1)
    piece(task, 0, data)[:] = _linear(rows.reshape(-1, zero.shape[0])[: task.rows], form)
    piece(task, 1, data)[:] = np.ascontiguousarray(scale.T).reshape(-1).view(np.uint8)
    if stores_zeros(task.kind, form):
        piece(task, 2, data)[:] = _linear(zero.T, form)


def _linear(codes: Array, form: Format) -> Array:
    """Return codes as ONNX stores (U)INT4 and (U)INT8; signed types hold them less the middle."""
    flat = np.ascontiguousarray(codes).reshape(-1)
    if form.symmetric:
        flat = (flat.astype(np.int16) - form.middle).astype(np.int8).view(np.uint8)
    if form.bits == 8:
        return flat
    if len(flat) % 2:
        flat = np.append(flat, np.uint8(0))
    packed: Array = (flat[0::2] & 15) | (flat[1::2] << 4)
    return packed


def _planes(task: Task, form: Format, tools: Tools, digest: Any) -> Iterator[tuple[Array, slice]]:
    """Yield planes of a weight, and which blocks they are when all are counted column by column."""
    source = task.source
    if not task.output_first:
        yield from _planes_of_columns(task, form, tools, digest)
        return
    whole = task.rows % form.block == 0
    row = (form.block if whole else task.rows) * source.item_bytes
    size, done = COMPUTED * source.item_bytes, 0
    for raw in _parts(source, row, tools, digest):
        if not whole:
            raw = np.pad(raw.reshape(-1, row), ((0, 0), (0, -task.rows % form.block * source.item_bytes))).reshape(-1)
        for part in range(0, len(raw), size):
            planes = planes_of(raw[part : part + size], source.dtype, form.block, tools.scratch)
            yield planes, slice(done, done + planes.shape[1])
            done += planes.shape[1]


def _parts(source: StoredTensor, unit: int, tools: Tools, digest: Any) -> Iterator[Array]:
    """Yield the bytes of a tensor, a few megabytes of whole units at a time, and hash them."""
    step = max(1, READ_BYTES // unit) * unit
    for begin in range(0, source.nbytes, step):
        raw = tools.read.read(source, begin, min(step, source.nbytes - begin))
        digest.update(raw)
        yield raw


def _planes_of_columns(task: Task, form: Format, tools: Tools, digest: Any) -> Iterator[tuple[Array, slice]]:
    source, count = task.source, -(-task.rows // form.block)
    step, width = COMPUTED // form.block, task.columns * source.item_bytes
    for block in range(count):
        height = min(form.block, task.rows - block * form.block)
        raw = tools.read.read(source, block * form.block * width, height * width)
        digest.update(raw)
        rows = as_float32(raw, source.dtype).reshape(height, task.columns)
        if height < form.block:
            rows = np.pad(rows, ((0, form.block - height), (0, 0)))
        for begin in range(0, task.columns, step):
            end = min(begin + step, task.columns)
            places = slice(begin * count + block, end * count, count)
            yield planes_of_rows(rows[:, begin:end], tools.scratch), places


def as_float32(raw: Array, dtype: str) -> Array:
    """Convert the bytes of F32, F16 or BF16 numbers to float32, one-dimensional."""
    if dtype == "F32":
        return raw.view(np.float32)
    if dtype == "F16":
        return raw.view(np.float16).astype(np.float32)
    wide = raw.view(np.uint16).astype(np.uint32)
    return np.left_shift(wide, 16, out=wide).view(np.float32)


def whole_weight(task: Task, tools: Tools) -> Array:
    """Return a weight as (columns, rows) float32: the layout of torch."""
    source = task.source
    wide = as_float32(stored_bytes(source, tools), source.dtype)
    check_finite(float(np.vdot(wide, wide)), source)
    if task.output_first:
        return wide.reshape(task.columns, task.rows)
    return np.ascontiguousarray(wide.reshape(task.rows, task.columns).T)


def copy_tensor(task: Task, first: int, count: int, tools: Tools, data: Array) -> dict[str, Any]:
    """Convert ``count`` elements of a tensor that is kept, from ``first`` on."""
    source = task.source
    raw = tools.read.read(source, first * source.item_bytes, count * source.item_bytes)
    digest = hashlib.sha256(raw.data).hexdigest()
    if source.dtype in FLOATS:
        wide = as_float32(raw, source.dtype)
        check_finite(float(np.max(np.abs(wide), initial=0)), source)
        raw = wide.view(np.uint8) if task.dtype == "F32" else _halved(wide, source).view(np.uint8)
    data[: len(raw)] = raw
    return {"tensor": source.name, "first": first, "sha256": digest}


def stored_bytes(source: StoredTensor, tools: Tools) -> Array:
    """Return all bytes of a tensor, (bytes,) uint8."""
    raw = np.empty(source.nbytes, np.uint8)
    for begin in range(0, source.nbytes, READ_BYTES):
        size = min(READ_BYTES, source.nbytes - begin)
        raw[begin : begin + size] = tools.read.read(source, begin, size)
    return raw


def stored_meaning(task: Task, data: Array, form: Format) -> Array:
    """Return what a finished record means to its layer: (columns, rows) float32."""
    count = -(-task.rows // form.block)
    codes = piece(task, 0, data)
    scale = piece(task, 1, data).view(np.float32)
    zero = np.full((task.columns, count), form.middle, np.uint8)
    if task.kind == "qdq":
        flat = _unlinear(codes, task.rows * task.columns, form).reshape(task.rows, task.columns).T
        scales = scale.reshape(count, task.columns).T
        if not form.symmetric:
            zero = _unlinear(piece(task, 2, data), zero.size, form).reshape(count, task.columns).T
        spread = [np.repeat(part, form.block, axis=1)[:, : task.rows] for part in (scales, zero.astype(np.float32))]
        meant: Array = (flat.astype(np.float32) - spread[1]) * spread[0]
    else:
        if not form.symmetric:
            zero = unpack_zeros(piece(task, 2, data).reshape(task.columns, -1), count, form)
        flat = dequantize(codes.reshape(-1, form.bytes), scale, zero.reshape(-1), form)
        meant = flat.reshape(task.columns, -1)[:, : task.rows]
    if task.scaled:
        meant = meant * piece(task, len(task.pieces) - 1, data).view(np.float32)
    return np.ascontiguousarray(meant)


def _unlinear(stored: Array, count: int, form: Format) -> Array:
    """Undo ``_linear``: unsigned codes, (count,) uint8."""
    flat = stored
    if form.bits == 4:
        flat = np.stack([stored & 15, stored >> 4], axis=1).reshape(-1)[:count]
    if form.symmetric:
        flat = (flat + np.uint8(form.middle)) & np.uint8(form.levels)
    return flat


def _halved(wide: Array, source: StoredTensor) -> Array:
    """Round to float16, refusing what it cannot hold."""
    largest = float(np.max(np.abs(wide), initial=0))
    if largest > 65504:
        raise GraphError(
            f"The table '{source.name}' in {source.file.name} holds {largest:.4g}, beyond float16.",
            "pass --embeddings float32",
        )
    return wide.astype(np.float16)
