"""Lines of JSON: whole, bounded, and no line that is not as it was written."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from _records import altered, record

from vlatool.errors import DataError, UsageError
from vlatool.runtime.telemetry import Delivery
from vlatool.runtime.telemetry.health import Health, HealthLevel, Timeout
from vlatool.runtime.telemetry.json_lines import JsonLines, read_lines


def lines_of(path: Path, count: int = 20, **more: Any) -> JsonLines:
    sink = JsonLines(path, **more)
    for step in range(count):
        sink(record(step))
    sink.close()
    return sink


def test_a_record_is_a_line(tmp_path: Path):
    sink = JsonLines(tmp_path / "deep" / "run.jsonl")
    sink(record(7, alarms=("stall",), action=np.float64([np.nan, 2.5])))
    sink(Delivery(7, 0.25))
    sink(record(8, action=None, error="DeadlineMissed: 'x'\n", missed=True, sensed_ms=None))
    sink(record(9, action=np.array(3)))
    sink.close()
    first, sent, missed, index = read_lines(sink.path)
    assert (first["action"], first["alarms"], first["checks"]) == ([None, 2.5], ["stall"], ["velocity"])
    assert (first["source"], first["infer_ms"], first["sensed_ms"]) == ("policy", 1.0, 1.5)
    assert sent == {"step": 7, "transport_ms": 0.25}
    assert (missed["missed"], missed["error"], missed["action"]) == (True, "DeadlineMissed: 'x'\n", None)
    assert index["action"] == 3


def test_files_are_bounded_and_the_newest_are_there(tmp_path: Path):
    lines_of(tmp_path / "run.jsonl", 200, max_bytes=5000, files=3)
    files = sorted(tmp_path.iterdir())
    assert [file.name for file in files] == ["run.jsonl", "run.jsonl.1", "run.jsonl.2"]
    assert max(file.stat().st_size for file in files) <= 5000
    steps = [values["step"] for file in reversed(files) for values in read_lines(file)]
    assert steps == list(range(steps[0], 200))
    lines_of(tmp_path / "run.jsonl", 1)
    assert [values["step"] for values in read_lines(tmp_path / "run.jsonl")] == [0], "a new run has a new file"
    assert list(read_lines(tmp_path / "run.jsonl.1"))[-1]["step"] == 199


def test_each_prefix_of_a_file_is_readable(tmp_path: Path):
    content = lines_of(tmp_path / "run.jsonl", 5).path.read_bytes()
    ends = [index + 1 for index, byte in enumerate(content) if byte == ord("\n")]
    for size in range(0, len(content), 7):
        (tmp_path / "cut").write_bytes(content[:size])
        steps = [values["step"] for values in read_lines(tmp_path / "cut")]
        assert steps == list(range(sum(end <= size for end in ends)))


def test_no_altered_line_is_read(tmp_path: Path):
    path = lines_of(tmp_path / "run.jsonl", 6).path
    content, random = path.read_bytes(), np.random.default_rng(4)
    whole = list(read_lines(path))
    for _ in range(200):
        path.write_bytes(altered(content, random))
        seen: list[Any] = []
        with contextlib.suppress(DataError):
            seen.extend(read_lines(path))
        assert seen == whole[: len(seen)]


def test_a_line_of_another_place_is_none(tmp_path: Path):
    path = lines_of(tmp_path / "run.jsonl", 4).path
    one, two, three, four = path.read_bytes().splitlines(keepends=True)
    for wrong in ([one, three, four], [two, one, three, four], [one, one, two], [three]):
        path.write_bytes(b"".join(wrong))
        with pytest.raises(DataError, match="is not as it was written"):
            list(read_lines(path))


@pytest.mark.parametrize("content", [b"x" * 1_500_000, b'{"a":' * 100_000 + b"\n", b'{"crc":"00000000"}\n', b"\n"])
def test_a_hostile_file_is_refused_at_once(tmp_path: Path, content: bytes):
    (tmp_path / "bad").write_bytes(content)
    with pytest.raises(DataError, match="line 1"):
        list(read_lines(tmp_path / "bad"))
    with pytest.raises(DataError, match="cannot be read"):
        list(read_lines(tmp_path / "none"))


def test_a_full_disk_loses_lines_and_no_file(tmp_path: Path):
    sink = JsonLines("/dev/full")
    sink.path = Path("/dev/full")
    sink._open = lambda: setattr(sink, "_handle", _full())  # type: ignore[method-assign]
    sink(record(0))
    with pytest.raises(OSError, match="No space left"):
        sink.flush()
    sink.path = tmp_path / "run.jsonl"
    del sink._open
    sink(record(1))
    sink.close()
    assert [values["step"] for values in read_lines(sink.path)] == [1]


def _full() -> int:
    import os

    return os.open("/dev/full", os.O_WRONLY)


def test_a_link_is_not_followed(tmp_path: Path):
    (tmp_path / "target").write_text("precious")
    (tmp_path / "run.jsonl").symlink_to(tmp_path / "target")
    lines_of(tmp_path / "run.jsonl", 2)
    assert (tmp_path / "target").read_text() == "precious"


def test_a_change_of_health_is_a_line(tmp_path: Path):
    now = [0.0]
    health = Health({"camera": Timeout(0.2, 1.0), "base": Timeout(5, 6)}, clock=lambda: now[0])
    sink = JsonLines(tmp_path / "run.jsonl", health=health)
    for now[0] in (0.1, 0.15, 0.5, 0.6, 1.5):
        sink.flush()
    health.beat("camera", HealthLevel.DEGRADED, "5 frames a second")
    sink.close()
    lines = list(read_lines(sink.path))
    assert [line["health"]["camera"] for line in lines] == ["ok", "degraded", "failed", "degraded"]
    assert lines[1]["reasons"] == {"camera": "silent for 0.5 s"}
    assert lines[3]["reasons"] == {"camera": "5 frames a second"}


@pytest.mark.parametrize("wrong", [{"max_bytes": 10}, {"files": 0}, {"files": True}])
def test_a_bound_that_is_none_is_refused(wrong: dict[str, Any]):
    with pytest.raises(UsageError, match=next(iter(wrong))):
        JsonLines("x", **wrong)
