"""Point clouds as arrays: any order of fields, offsets, byte orders and types."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vlatool.errors import BusError
from vlatool.messages import cdr, same
from vlatool.messages.clouds import DTYPES, points, points_message, values
from vlatool.messages.sensor_msgs import PointCloud2, PointField
from vlatool.messages.std_msgs import Header

POINTS = np.random.default_rng(1).normal(0, 5, (12, 3)).astype(np.float32)
NUMBERS = {code: number for number, code in DTYPES.items()}


def _cloud(columns: dict[str, np.ndarray], height: int = 1, big: bool = False, padding: int = 0) -> PointCloud2:
    """A cloud of named columns in their order, each behind three unused bytes, with bytes at the end of each row."""
    fields, parts, offset = [], [], 0
    count = len(next(iter(columns.values())))
    for name, column in columns.items():
        stored = np.ascontiguousarray(column.astype(column.dtype.newbyteorder(">" if big else "<")).reshape(count, -1))
        offset += 3
        parts += [np.full((count, 3), 77, np.uint8), stored.view(np.uint8)]
        fields.append(PointField(name, offset, NUMBERS[column.dtype.str[1:]], stored.shape[1]))
        offset += parts[-1].shape[1]
    rows = np.hstack(parts).reshape(height, -1)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=88)
    width = count // height
    return PointCloud2(
        Header(), height, width, tuple(fields), big, offset, rows.shape[1], np.ascontiguousarray(rows).reshape(-1), True
    )


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize(("height", "padding"), [(1, 0), (1, 5), (3, 0), (4, 9)])
@pytest.mark.parametrize("names", ["xyz", "zxy", "yzx"])
def test_points_in_any_layout(names: str, height: int, padding: int, big: bool) -> None:
    columns = {name: POINTS[:, "xyz".index(name)] for name in names}
    cloud = _cloud(
        {"ring": np.arange(12, dtype=np.uint16), **columns, "rgb": np.zeros(12, np.float32)}, height, big, padding
    )
    found = points(cdr.decode(PointCloud2, cdr.encode(cloud)))
    assert same(found, POINTS)
    assert values(cloud, "ring").tolist() == list(range(12))


@pytest.mark.parametrize("code", sorted(DTYPES.values()))
def test_points_of_any_type(code: str) -> None:
    whole = np.clip(np.rint(POINTS), 0, None).astype(code)
    assert same(points(_cloud({name: whole[:, i] for i, name in enumerate("xyz")}, big=True)), whole.astype(np.float32))
    assert values(_cloud({"x": whole[:, 0]}), "x").dtype == np.dtype(code)


def test_points_without_a_position_are_left_out() -> None:
    array = np.array([[1, 2, 3], [np.nan, 0, 0], [0, np.inf, 0], [4, 5, 6], [0, 0, -np.inf]], np.float32)
    assert points(points_message(array)).tolist() == [[1, 2, 3], [4, 5, 6]]
    assert len(values(points_message(array), "x")) == 5
    assert not points_message(array).is_dense
    wide = np.array([[1e300, 0, 0], [1, 2, 3]])
    assert points(_cloud({name: wide[:, i] for i, name in enumerate("xyz")})).tolist() == [[1, 2, 3]]


def test_fields_of_several_elements() -> None:
    histogram = np.arange(12.0).reshape(4, 3)
    assert same(values(_cloud({"h": histogram}, height=2), "h"), histogram)
    cloud = points_message(POINTS)
    unset = replace(cloud, fields=tuple(replace(field, count=0) for field in cloud.fields))
    assert same(points(unset), POINTS)  # some drivers leave the count 0


@pytest.mark.parametrize("several", ["x", "xyz"])
def test_a_coordinate_of_several_elements_is_none(several: str) -> None:
    columns = {name: np.zeros((4, 2) if name in several else 4, np.float32) for name in "xyz"}
    with pytest.raises(BusError, match="'x' has 2 elements"):
        points(_cloud(columns))


def test_names_of_fields_are_shown_in_part() -> None:
    with pytest.raises(BusError) as refused:
        points(_cloud({"n" * 10_000 + str(number): np.zeros(4, np.float32) for number in range(9)}))
    assert len(refused.value.message) < 1000


def test_empty_clouds() -> None:
    for cloud in (PointCloud2(), points_message(POINTS[:0]), replace(points_message(POINTS), width=0)):
        assert same(points(cloud), np.zeros((0, 3), np.float32))
    assert values(points_message(POINTS[:0]), "x").shape == (0,)


def test_message_of_points() -> None:
    cloud = points_message(POINTS.astype(np.float64), Header(frame_id="lidar"))
    assert (cloud.height, cloud.width, cloud.point_step, cloud.row_step) == (1, 12, 12, 144)
    assert cloud.header.frame_id == "lidar"
    assert cloud.is_dense
    assert [(field.name, field.offset, field.datatype, field.count) for field in cloud.fields] == [
        ("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1),
    ]  # fmt: skip
    assert same(points(cdr.decode(PointCloud2, cdr.encode(cloud))), POINTS)
    for array in (POINTS[:, :2], POINTS[0], np.full((1, 3), "a")):
        with pytest.raises(BusError, match=r"takes \(N, 3\)"):
            points_message(array)


CLOUD = points_message(POINTS)
X, Y, Z = CLOUD.fields


@pytest.mark.parametrize(("cloud", "problem"), [
    (replace(CLOUD, fields=(X, Y)), "0 fields named 'z'; its fields: x, y"),
    (replace(CLOUD, fields=(X, Y, Z, X)), "2 fields named 'x'"),
    (replace(CLOUD, fields=(X, Y, replace(Z, datatype=9))), "'z' is of datatype 9"),
    (replace(CLOUD, fields=(X, Y, replace(Z, offset=9))), "'z' ends behind its points"),
    (replace(CLOUD, fields=(X, Y, replace(Z, count=2**32 - 1))), "'z' ends behind its points"),
    (replace(CLOUD, width=13), "13 x 1 points.*rows of 144 bytes"),
    (replace(CLOUD, width=2**32 - 1, height=2**32 - 1, row_step=2**32 - 1), "4294967295 x 4294967295 points"),
    (replace(CLOUD, data=CLOUD.data[:-1]), "143 bytes of data"),
    (replace(CLOUD, point_step=0), "ends behind its points of 0 bytes"),
    (replace(CLOUD, row_step=0), "rows of 0 bytes"),
])  # fmt: skip
def test_clouds_that_do_not_fit(cloud: PointCloud2, problem: str) -> None:
    with pytest.raises(BusError, match=f"(?s){problem}") as caught:
        points(cloud)
    assert caught.value.fix
