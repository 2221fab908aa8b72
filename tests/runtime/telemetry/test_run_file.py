"""The file of a recorded run: each prefix is readable, and no frame that is not as it was written is read."""

from __future__ import annotations

import contextlib
import os
import signal
import struct
import subprocess
import sys
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from _records import altered

from vlatool.errors import DataError
from vlatool.runtime.telemetry.run_file import HEAD, MAGIC, Frame, FrameKind, RunWriter, read_run


def written(path: Path, steps: int = 4) -> bytes:
    writer = RunWriter(path)
    writer.append(Frame(FrameKind.HEADER, {"name": "run"}, {}))
    for step in range(steps):
        arrays = {"a": np.arange(step + 3, dtype=np.float32), "b": np.array(step > 1), "c": np.zeros((2, 0), np.uint8)}
        writer.append(Frame(FrameKind.TICK, {"step": step, "clock": [0.1 + step, 1e-300]}, arrays))
    writer.append(Frame(FrameKind.END, {"omitted": 0}, {}))
    writer.close()
    return path.read_bytes()


def plain(frame: Frame) -> Any:
    arrays = {name: (array.dtype.name, array.shape, array.tobytes()) for name, array in frame.arrays.items()}
    return frame.kind, frame.values, arrays


def read(path: Path) -> tuple[list[Any], bool]:
    """Return the frames that can be read, and whether the file is refused after them."""
    frames: list[Any] = []
    try:
        frames.extend(map(plain, read_run(path)))
    except DataError:
        return frames, True
    return frames, False


def test_what_is_written_is_read(tmp_path: Path):
    content = written(tmp_path / "run")
    frames, refused = read(tmp_path / "run")
    assert (len(frames), refused) == (6, False)
    assert frames[2][1] == {"step": 1, "clock": [1.1, 1e-300]}
    assert frames[2][2] == {"a": ("float32", (4,), np.arange(4, dtype=np.float32).tobytes()),
                            "b": ("bool", (), b"\0"), "c": ("uint8", (2, 0), b"")}  # fmt: skip
    with pytest.raises(DataError, match="File exists"):
        RunWriter(tmp_path / "run")
    assert (tmp_path / "run").read_bytes() == content


def test_each_prefix_is_readable(tmp_path: Path):
    content, cut = written(tmp_path / "run"), tmp_path / "cut"
    whole, _ = read(tmp_path / "run")
    for size in range(len(MAGIC), len(content), 5):
        cut.write_bytes(content[:size])
        frames, refused = read(cut)
        assert (frames, refused) == (whole[: len(frames)], False)
    assert len(frames) == len(whole) - 1


def test_no_altered_frame_is_read(tmp_path: Path):
    content, bad, random = written(tmp_path / "run"), tmp_path / "bad", np.random.default_rng(1)
    whole, refusals = read(tmp_path / "run")[0], 0
    for _ in range(250):
        bad.write_bytes(altered(content, random))
        frames, refused = read(bad)
        assert frames == whole[: len(frames)]
        refusals += refused
    assert refusals > 125, "the others end early"


def framed(*contents: bytes, kind: int = FrameKind.HEADER) -> bytes:
    """Return a file of frames with right checksums."""
    whole, crc = MAGIC, 0
    for content in contents:
        frame = HEAD.pack(kind, len(content)) + content
        crc = zlib.crc32(frame, crc)
        whole, kind = whole + frame + struct.pack("<I", crc), FrameKind.TICK
    return whole


def text(value: str, rest: bytes = b"") -> bytes:
    return struct.pack("<I", len(value)) + value.encode() + rest


@pytest.mark.parametrize(
    "content",
    [b"", b"PK\x03\x04", framed(b""), framed(b"\xff\xff\xff\xff"), framed(text("[]")), framed(text("[{}]")),
     framed(text("[[],[]]")), framed(text("[{},[]]", b"more")), framed(text('[{},[["a","object",[1]]]]', b"12345678")),
     framed(text('[{},[["a","float32",[-1]]]]', b"")), framed(text('[{},[["a","float32",[1e9]]]]')),
     framed(text('[{},[["a","float32",[4611686018427387904,4]]]]')),
     framed(text('[{},[["a","float32",[true]]]]', b"1234")),
     framed(text('[{},[["a","uint8",[1]],["a","uint8",[1]]]]', b"12")), framed(text('[{},[[[],"uint8",[1]]]]', b"1")),
     framed(text('[{},[["a","uint8",' + "[" * 90 + "]" * 90 + "]]]")), framed(text("[" * 100_000)),
     framed(text("[{},[]]"), kind=FrameKind.TICK), framed(text("[{},[]]"), kind=9), framed(text('[{"x":NaN},[]]')),
     framed(text("[{},[]]"), text("[{},[]]"))[:-1] + b"x", framed(text('[{},[["a","uint8",' + str([1] * 99) + "]]]"), ),
     framed(text("[{},5]")), framed(text('[{},{"a":1}]'))],
    ids=range(24),
)  # fmt: skip
def test_a_hostile_file_is_refused(tmp_path: Path, content: bytes):
    (tmp_path / "bad").write_bytes(content)
    with pytest.raises(DataError, match=r"is not a recorded run|not as it was written"):
        list(read_run(tmp_path / "bad"))


def test_a_length_without_end_allocates_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with (tmp_path / "sparse").open("wb") as file:
        file.write(MAGIC + HEAD.pack(FrameKind.HEADER, 2**31))
        file.truncate(2**33)
    with pytest.raises(DataError, match="run_frame_bytes"):
        list(read_run(tmp_path / "sparse"))
    with pytest.raises(DataError, match="cannot be read"):
        list(read_run(tmp_path))


KILLED = """
import sys
import numpy as np
from vlatool.runtime.telemetry.run_file import Frame, FrameKind, RunWriter
writer = RunWriter(sys.argv[1])
writer.append(Frame(FrameKind.HEADER, {}, {}))
step = 0
while True:
    writer.append(Frame(FrameKind.TICK, {"step": step}, {"a": np.full(5000, step)}))
    print(step, flush=True)
    step += 1
"""


def test_a_killed_process_leaves_all_that_it_wrote(tmp_path: Path):
    process = subprocess.Popen([sys.executable, "-c", KILLED, str(tmp_path / "run")], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    with contextlib.closing(process.stdout) as told:
        for _ in range(20):
            last = int(told.readline())
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        last = max([last, *map(int, told.read().split())])
    frames, refused = read(tmp_path / "run")
    assert not refused
    assert [values["step"] for _, values, _ in frames[1:]] == list(range(len(frames) - 1))
    assert len(frames) - 2 >= last
