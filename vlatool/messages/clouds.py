"""Point clouds as NumPy arrays and back."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import BusError
from vlatool.messages._names_text import names_text
from vlatool.messages.sensor_msgs import PointCloud2, PointField
from vlatool.messages.std_msgs import Header

Array = NDArray[Any]
DTYPES = {
    PointField.INT8: "i1", PointField.UINT8: "u1", PointField.INT16: "i2", PointField.UINT16: "u2",
    PointField.INT32: "i4", PointField.UINT32: "u4", PointField.FLOAT32: "f4", PointField.FLOAT64: "f8",
}  # fmt: skip
"""``PointField.datatype`` -> NumPy's code."""
COORDINATES = ("x", "y", "z")
DRIVER = "check the driver of the sensor that publishes the cloud"


def points(message: PointCloud2) -> Array:
    """Return the points, (N, 3) float32 in metres, row by row, without those that have a coordinate of NaN or infinity.

    Raises:
        BusError: for a cloud without x, y and z, or data that do not fit its size.
    """
    if not message.height * message.width:
        return np.zeros((0, len(COORDINATES)), np.float32)
    columns = {name: values(message, name) for name in COORDINATES}
    if several := next((name for name, column in columns.items() if column.ndim > 1), ""):
        count = columns[several].shape[1]
        raise BusError(f"A point cloud whose field {several!r} has {count} elements, not one.", DRIVER)
    with np.errstate(over="ignore"):
        found = np.stack([column.astype(np.float32) for column in columns.values()], axis=1)
    return found[np.isfinite(found).all(axis=1)]


def values(message: PointCloud2, name: str) -> Array:
    """Return one field of all points, (N,) or (N, count) of its own dtype, row by row.

    Args:
        message: The cloud; the order of its fields, their offsets and its byte order do not matter.
        name: Field, such as ``x`` or ``intensity``.

    Raises:
        BusError: for a field that the cloud lacks or has twice, or data that do not fit its size.
    """
    fields = [field for field in message.fields if field.name == name]
    if len(fields) != 1:
        known = names_text(field.name for field in message.fields)
        raise BusError(f"A point cloud with {len(fields)} fields named {name!r}; its fields: {known}.", DRIVER)
    field, step = fields[0], message.point_step
    if field.datatype not in DTYPES:
        raise BusError(f"A point cloud whose field {name!r} is of datatype {field.datatype}, not 1 to 8.", DRIVER)
    dtype = np.dtype(DTYPES[field.datatype]).newbyteorder(">" if message.is_bigendian else "<")
    count = max(1, field.count)  # some drivers leave it 0
    if field.offset + count * dtype.itemsize > step:
        raise BusError(f"A point cloud whose field {name!r} ends behind its points of {step} bytes.", DRIVER)
    data = _data(message)
    shape, strides = (message.height, message.width, count), (message.row_step, step, dtype.itemsize)
    found: Array = (
        np.ndarray(shape, dtype, data, field.offset, strides)
        if message.height * message.width
        else np.zeros(shape, dtype)
    )
    found = found.astype(dtype.newbyteorder("="))
    return found.reshape(-1) if count == 1 else found.reshape(-1, count)


def _data(message: PointCloud2) -> Array:
    """Return the bytes of a cloud.

    Raises:
        BusError: when they are fewer than its size says.
    """
    data = np.frombuffer(message.data, np.uint8) if isinstance(message.data, bytes) else message.data
    height, width, step, row = message.height, message.width, message.point_step, message.row_step
    if height * width and (row < width * step or len(data) < (height - 1) * row + width * step):
        raise BusError(
            f"A point cloud of {width} x {height} points of {step} bytes, with rows of {row:,} bytes and {len(data):,} "
            f"bytes of data; a row takes {width * step:,}.",
            DRIVER,
        )
    return np.ascontiguousarray(data)


def points_message(array: Array, header: Header | None = None) -> PointCloud2:
    """Return an unorganized cloud of fields x, y, z.

    Args:
        array: (N, 3) points in metres, which are sent as float32.
        header: Moment and frame.

    Raises:
        BusError: for an array of another shape, or not of numbers.
    """
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "fiu":
        raise BusError(
            f"An array {array.shape} of {array.dtype} for a point cloud, which takes (N, 3) numbers.", "give x, y, z"
        )
    data = np.ascontiguousarray(array, np.float32)
    fields = tuple(PointField(name, 4 * index, PointField.FLOAT32, 1) for index, name in enumerate(COORDINATES))
    big, dense = sys.byteorder == "big", bool(np.isfinite(data).all())
    return PointCloud2(
        header or Header(), 1, len(data), fields, big, 12, 12 * len(data), data.reshape(-1).view(np.uint8), dense
    )
