"""Peak memory of sampling a dataset of many episodes: the frames stay on the disk.

python tests/validation/soak/dataset_memory.py --episodes 10000 --frames 10 --limit-mb 500
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

HEIGHT, WIDTH, HZ, EPISODES_A_FILE = 96, 128, 10, 1000
SAMPLE = """
import resource, sys, time
from pathlib import Path
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.data import NamedRecording, sample_recording
import numpy
def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
before, start = peak(), time.monotonic()
spec = PolicySpec((TensorSpec("top", (1, 96, 128, 3), "uint8"), TensorSpec("state", (1, 14))),
                  (TensorSpec("action", (1, 50, 14)),), 10.0, 50)
count = sample_recording(NamedRecording(Path(sys.argv[1])), 128, spec, Path(sys.argv[2]))
print(count, round(before), round(peak()), round(time.monotonic() - start, 1))
"""


def write_video(path: Path, frames: int, first: int) -> None:
    import av

    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=HZ, options={"preset": "ultrafast"})
        stream.width, stream.height, stream.pix_fmt, stream.codec_context.gop_size = WIDTH, HEIGHT, "yuv420p", 2
        pixels = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        for at in range(frames):
            pixels[:] = (first + at) % 251
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        container.mux(stream.encode())


def write(folder: Path, episodes: int, frames: int) -> None:
    """Write a dataset in the layout of LeRobot v3.0."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    camera = "observation.images.top"
    vector = {"dtype": "float32", "shape": [14], "names": None}
    info = {"codebase_version": "v3.0", "total_episodes": episodes, "total_frames": episodes * frames, "fps": HZ,
            "chunks_size": 1000, "features": {
                camera: {"dtype": "video", "shape": [HEIGHT, WIDTH, 3]}, "observation.state": vector, "action": vector,
                "task_index": {"dtype": "int64", "shape": [1]}}}  # fmt: skip
    (folder / "meta/episodes/chunk-000").mkdir(parents=True)
    (folder / "meta/info.json").write_text(json.dumps(info))
    numbers, random = np.arange(episodes), np.random.default_rng(0)
    files = numbers // EPISODES_A_FILE
    table = {"episode_index": numbers, "data/chunk_index": files * 0, "data/file_index": files,
             f"videos/{camera}/chunk_index": files * 0, f"videos/{camera}/file_index": files,
             f"videos/{camera}/from_timestamp": numbers % EPISODES_A_FILE * frames / HZ}  # fmt: skip
    pq.write_table(pa.table(table), folder / "meta/episodes/chunk-000/file-000.parquet")
    (folder / "data/chunk-000").mkdir(parents=True)
    for file in range(files[-1] + 1):
        inside = np.repeat(numbers[files == file], frames)
        columns: dict[str, Any] = {
            name: pa.array(list(random.normal(size=(len(inside), 14)).astype(np.float32)), pa.list_(pa.float32(), 14))
            for name in ("observation.state", "action")
        }
        columns["timestamp"] = (np.tile(np.arange(frames), len(inside) // frames) / HZ).astype(np.float32)
        columns |= {"episode_index": inside, "task_index": inside % 5}
        pq.write_table(pa.table(columns), folder / f"data/chunk-000/file-{file:03d}.parquet")
        write_video(folder / f"videos/{camera}/chunk-000/file-{file:03d}.mp4", len(inside), file)


def main() -> int:
    """Write, sample in a process of its own, print; 1 when the peak is above the limit."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=10_000)
    parser.add_argument("--frames", type=int, default=10, help="of an episode")
    parser.add_argument("--limit-mb", type=float, default=500)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "data"
        start = time.monotonic()
        write(folder, arguments.episodes, arguments.frames)
        size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) / 1e6
        print(f"{arguments.episodes * arguments.frames} frames, {size:.0f} MB, in {time.monotonic() - start:.0f} s")
        command = [sys.executable, "-c", SAMPLE, str(folder), str(Path(place) / "sample.npz")]
        count, before, peak, seconds = subprocess.run(
            command, check=True, stdout=subprocess.PIPE, text=True
        ).stdout.split()
    print(f"{count} samples in {seconds} s, peak {peak} MB resident ({before} MB after the imports)")
    return int(float(peak) > arguments.limit_mb)


if __name__ == "__main__":
    raise SystemExit(main())
