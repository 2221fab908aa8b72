"""Convert the stored bytes of one tensor to the bytes of its record, a few megabytes at a time."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.errors import GraphError
from vlatool.quantize.streamed._block_quantization import (
    METHODS,
    BlockFormat,
    ParameterChoice,
    Scratch,
    dequantize,
    pack_nibbles,
    pack_zero_points,
    planes_from_bytes,
    planes_from_rows,
    quantize_planes,
    unpack,
    unpack_nibbles,
    unpack_zero_points,
)
from vlatool.quantize.streamed._graph_rewrite import PART_BYTES, Piece, Task, stores_zeros
from vlatool.quantize.streamed.records import Record, Tools, round_to_page
from vlatool.runtime.interface import Array
from vlatool.weights.shards import FLOATS, StoredTensor

READ_BYTES = 1 << 22
CHUNK_ELEMENTS = 1 << 17
"""Elements computed at once: as many as fit into a core's cache."""
COPY_ITEM_BYTES = {"F32": 4, "F16": 2}


@dataclass(frozen=True)
class Job:
    """Computation of one record, in plain values that can be sent to another process.

    Args:
        choose: Name in ``METHODS`` of the method that finds scales and zero points.
        tolerance: Largest relative L2 error of a quantized weight.
        first, count: Range of elements, for a tensor that is copied.
    """

    task: Task
    form: BlockFormat
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
        """Return the job as one line of JSON for ``from_json``; tensors in memory cannot be sent."""
        return json.dumps(asdict(self), default=str)

    @classmethod
    def from_json(cls, line: str) -> Job:
        """Build a job from its line."""
        fields = json.loads(line)
        task, form = fields.pop("task"), BlockFormat(**fields.pop("form"))
        source = task["source"] | {"file": Path(task["source"]["file"]), "shape": tuple(task["source"]["shape"])}
        pieces = tuple(Piece(**{**entry, "shape": tuple(entry["shape"])}) for entry in task["pieces"])
        return cls(Task(**{**task, "source": StoredTensor(**source), "pieces": pieces}), form, **fields)


def records_for(task: Task, form: BlockFormat, choose: str, tolerance: float) -> list[Record]:
    """Return the records of a task, consecutive in the file; a copied tensor is cut into several."""
    source = task.source
    if task.kind != "copy":
        job = Job(task, form, choose, tolerance)
        return [Record(task.label, round_to_page(task.size), job, source.count, source.array is None)]
    width = COPY_ITEM_BYTES.get(task.dtype) or source.item_bytes
    step, records = PART_BYTES // width, []
    for first in range(0, max(source.count, 1), step):
        count = min(step, source.count - first)
        job = Job(task, form, choose, tolerance, first, count)
        records.append(Record(task.label, round_to_page(count * width), job, count, source.array is None, "copied"))
    return records


def quantize_tensor(
    task: Task, form: BlockFormat, choose: ParameterChoice, tolerance: float, tools: Tools, data: Array
) -> dict[str, Any]:
    """Quantize a weight into its record; return figures; raises GraphError if not finite, or beyond the tolerance."""
    shape = (task.columns, -(-task.rows // form.block))
    stored = piece_bytes(task, 0, data) if task.kind == "blocks" else np.empty((*shape, form.code_bytes), np.uint8)
    stored = stored.reshape(-1, form.code_bytes)
    scale, zero = tools.scratch("scale", shape), tools.scratch("zero", shape, np.uint8)
    digest = hashlib.sha256()
    lost = norm = 0.0
    for planes, blocks in _planes(task, form, tools, digest):
        quantized = quantize_planes(planes, form, choose, tools.scratch, stored[blocks])
        check_finite(quantized.squared_norm, task.source)
        scale.reshape(-1)[blocks], zero.reshape(-1)[blocks] = quantized.scale, quantized.zero
        lost += quantized.squared_error
        norm += quantized.squared_norm
    store_parameters(task, form, stored, scale, zero, data)
    return {**loss_figures(task, lost, norm, tolerance), "sha256": digest.hexdigest()}


def loss_figures(task: Task, lost: float, norm: float, tolerance: float) -> dict[str, Any]:
    """Return name, shape and relative error of a quantized weight; refuse an error above ``tolerance``."""
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
            "train or download it again; a policy with such a weight does not give finite actions",
        )


def piece_bytes(task: Task, number: int, data: Array) -> Array:
    """Return the bytes of one tensor of a record."""
    piece = task.pieces[number]
    return data[piece.offset : piece.offset + piece.size]


def store_parameters(task: Task, form: BlockFormat, stored: Array, scale: Array, zero: Array, data: Array) -> None:
    """Write scales and zero points, (columns, blocks) each, and, for QDQ, the codes in its layout."""
    if task.kind == "blocks":
        piece_bytes(task, 1, data)[:] = scale.reshape(-1).view(np.uint8)
        if not form.symmetric:
            piece_bytes(task, 2, data)[:] = pack_zero_points(zero, form).reshape(-1)
        return
    planes = unpack(stored.reshape(-1, form.code_bytes), form, Scratch())
    half = form.block // 2
    rows = np.empty((zero.shape[1], form.block, zero.shape[0]), np.uint8)
    shaped = planes.reshape(form.block, *zero.shape)
    rows[:, 0::2], rows[:, 1::2] = shaped[:half].transpose(2, 0, 1), shaped[half:].transpose(2, 0, 1)
    piece_bytes(task, 0, data)[:] = _pack_linear(rows.reshape(-1, zero.shape[0])[: task.rows], form)
    piece_bytes(task, 1, data)[:] = np.ascontiguousarray(scale.T).reshape(-1).view(np.uint8)
    if stores_zeros(task.kind, form):
        piece_bytes(task, 2, data)[:] = _pack_linear(zero.T, form)


def _pack_linear(codes: Array, form: BlockFormat) -> Array:
    """Return codes in ONNX's format of (U)INT4 and (U)INT8; signed types hold them minus the midpoint."""
    flat = np.ascontiguousarray(codes).reshape(-1)
    if form.symmetric:
        flat = (flat.astype(np.int16) - form.midpoint).astype(np.int8).view(np.uint8)
    return flat if form.bits == 8 else pack_nibbles(flat)


def _planes(task: Task, form: BlockFormat, tools: Tools, digest: Any) -> Iterator[tuple[Array, slice]]:
    """Yield planes of a weight, and the range of their blocks, counted column by column."""
    source = task.source
    if not task.output_first:
        yield from _planes_of_columns(task, form, tools, digest)
        return
    whole = task.rows % form.block == 0
    row = (form.block if whole else task.rows) * source.item_bytes
    size, done = CHUNK_ELEMENTS * source.item_bytes, 0
    for raw in _byte_chunks(source, row, tools, digest):
        if not whole:
            raw = np.pad(raw.reshape(-1, row), ((0, 0), (0, -task.rows % form.block * source.item_bytes))).reshape(-1)
        for part in range(0, len(raw), size):
            planes = planes_from_bytes(raw[part : part + size], source.dtype, form.block, tools.scratch)
            yield planes, slice(done, done + planes.shape[1])
            done += planes.shape[1]


def _byte_chunks(source: StoredTensor, unit: int, tools: Tools, digest: Any) -> Iterator[Array]:
    """Yield and hash the bytes of a tensor, a few megabytes of whole units at a time."""
    step = max(1, READ_BYTES // unit) * unit
    for begin in range(0, source.nbytes, step):
        raw = tools.reader.read(source, begin, min(step, source.nbytes - begin))
        digest.update(raw)
        yield raw


def _planes_of_columns(task: Task, form: BlockFormat, tools: Tools, digest: Any) -> Iterator[tuple[Array, slice]]:
    source, count = task.source, -(-task.rows // form.block)
    step, width = CHUNK_ELEMENTS // form.block, task.columns * source.item_bytes
    for block in range(count):
        height = min(form.block, task.rows - block * form.block)
        raw = tools.reader.read(source, block * form.block * width, height * width)
        digest.update(raw)
        rows = as_float32(raw, source.dtype).reshape(height, task.columns)
        if height < form.block:
            rows = np.pad(rows, ((0, form.block - height), (0, 0)))
        for begin in range(0, task.columns, step):
            end = min(begin + step, task.columns)
            blocks = slice(begin * count + block, end * count, count)
            yield planes_from_rows(rows[:, begin:end], tools.scratch), blocks


def as_float32(raw: Array, dtype: str) -> Array:
    """Convert the bytes of F32, F16 or BF16 numbers to float32, one-dimensional."""
    if dtype == "F32":
        return raw.view(np.float32)
    if dtype == "F16":
        return raw.view(np.float16).astype(np.float32)
    values = raw.view(np.uint16).astype(np.uint32)
    return np.left_shift(values, 16, out=values).view(np.float32)


def read_weight(task: Task, tools: Tools) -> Array:
    """Return a weight as (columns, rows) float32, torch's layout."""
    source = task.source
    values = as_float32(read_bytes(source, tools), source.dtype)
    check_finite(float(np.vdot(values, values)), source)
    if task.output_first:
        return values.reshape(task.columns, task.rows)
    return np.ascontiguousarray(values.reshape(task.rows, task.columns).T)


def copy_tensor(task: Task, first: int, count: int, tools: Tools, data: Array) -> dict[str, Any]:
    """Copy and convert ``count`` elements of a tensor, from ``first`` on."""
    source = task.source
    raw = tools.reader.read(source, first * source.item_bytes, count * source.item_bytes)
    digest = hashlib.sha256(raw.data).hexdigest()
    if source.dtype in FLOATS:
        values = as_float32(raw, source.dtype)
        check_finite(float(np.max(np.abs(values), initial=0)), source)
        raw = values.view(np.uint8) if task.dtype == "F32" else _to_float16(values, source).view(np.uint8)
    data[: len(raw)] = raw
    return {"tensor": source.name, "first": first, "sha256": digest}


def read_bytes(source: StoredTensor, tools: Tools) -> Array:
    """Return all bytes of a tensor, (bytes,) uint8."""
    raw = np.empty(source.nbytes, np.uint8)
    for begin in range(0, source.nbytes, READ_BYTES):
        size = min(READ_BYTES, source.nbytes - begin)
        raw[begin : begin + size] = tools.reader.read(source, begin, size)
    return raw


def dequantize_record(task: Task, data: Array, form: BlockFormat) -> Array:
    """Return the effective weight of a finished record: (columns, rows) float32."""
    count = -(-task.rows // form.block)
    codes = piece_bytes(task, 0, data)
    scale = piece_bytes(task, 1, data).view(np.float32)
    zero = np.full((task.columns, count), form.midpoint, np.uint8)
    if task.kind == "qdq":
        flat = _unpack_linear(codes, task.rows * task.columns, form).reshape(task.rows, task.columns).T
        scales = scale.reshape(count, task.columns).T
        if not form.symmetric:
            zero = _unpack_linear(piece_bytes(task, 2, data), zero.size, form).reshape(count, task.columns).T
        spread = [np.repeat(part, form.block, axis=1)[:, : task.rows] for part in (scales, zero.astype(np.float32))]
        restored: Array = (flat.astype(np.float32) - spread[1]) * spread[0]
    else:
        if not form.symmetric:
            zero = unpack_zero_points(piece_bytes(task, 2, data).reshape(task.columns, -1), count, form)
        flat = dequantize(codes.reshape(-1, form.code_bytes), scale, zero.reshape(-1), form)
        restored = flat.reshape(task.columns, -1)[:, : task.rows]
    if task.scaled:
        restored = restored * piece_bytes(task, len(task.pieces) - 1, data).view(np.float32)
    return np.ascontiguousarray(restored)


def _unpack_linear(stored: Array, count: int, form: BlockFormat) -> Array:
    """Undo ``_pack_linear``: unsigned codes, (count,) uint8."""
    flat = stored if form.bits == 8 else unpack_nibbles(stored, count)
    if form.symmetric:
        flat = (flat + np.uint8(form.midpoint)) & np.uint8(form.levels)
    return flat


def _to_float16(values: Array, source: StoredTensor) -> Array:
    """Round to float16, refusing values beyond its range."""
    largest = float(np.max(np.abs(values), initial=0))
    if largest > 65504:
        raise GraphError(
            f"The table '{source.name}' in {source.file.name} holds {largest:.4g}, beyond float16.",
            "pass --embeddings float32",
        )
    return values.astype(np.float16)
