"""Small datasets, written by the library of each format in the layout of the tool that records it."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

HZ = 10
LENGTHS = (6, 9, 4)
COUNT = sum(LENGTHS)
EPISODES = np.repeat(np.arange(len(LENGTHS)), LENGTHS)
FRAMES = np.concatenate([np.arange(length) for length in LENGTHS])
STATE = np.stack([np.arange(COUNT), -np.arange(COUNT), EPISODES], 1).astype(np.float32)
ACTION = np.stack([np.arange(COUNT) / 2, np.arange(COUNT) * 3], 1).astype(np.float32)
TASKS = ("pick the cube", "place the cube")
HEIGHT, WIDTH = 48, 64


def picture(row: int, shift: int = 0) -> Any:
    """A picture whose grey value says which row it is of: lossy codecs keep that."""
    pixels = np.full((HEIGHT, WIDTH, 3), 20 + 10 * row, np.uint8)
    pixels[:, WIDTH // 2 :] = 230 - 10 * row + shift
    return pixels


def row_of(pixels: Any) -> int:
    """The row that a picture is of."""
    return round((float(np.median(pixels[:, : WIDTH // 2 - 8])) - 20) / 10)


@contextlib.contextmanager
def usual_priority() -> Iterator[None]:
    """Give this process its priority back: SVT-AV1, run by root, leaves it and its children at SCHED_FIFO 99."""
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        yield
    finally:
        os.sched_setscheduler(0, policy, parameters)


def write_video(path: Path, rows: Sequence[int], codec: str = "libx264", gop: int = 4) -> None:
    import av

    path.parent.mkdir(parents=True, exist_ok=True)
    with usual_priority(), av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=HZ)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.codec_context.gop_size = gop
        for row in rows:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture(row), format="rgb24")))
        container.mux(stream.encode())


def png(pixels: Any) -> bytes:
    import io

    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "PNG")
    return stream.getvalue()


def _features(kind: str) -> dict[str, Any]:
    camera = {"dtype": kind, "shape": [HEIGHT, WIDTH, 3], "names": ["height", "width", "channels"]}
    one = {"dtype": "int64", "shape": [1], "names": None}
    return {
        "observation.images.top": camera, "observation.images.wrist": camera,
        "observation.state": {"dtype": "float32", "shape": [3], "names": ["a", "b", "c"]},
        "action": {"dtype": "float32", "shape": [2], "names": ["x", "y"]},
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
        **dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), one),
    }  # fmt: skip


def _table(rows: Any, kind: str) -> Any:
    import pyarrow as pa

    columns = {
        "observation.state": pa.array(list(STATE[rows]), pa.list_(pa.float32(), 3)),
        "action": pa.array(list(ACTION[rows]), pa.list_(pa.float32())),
        "timestamp": pa.array((FRAMES[rows] / HZ).astype(np.float32)),
        "frame_index": FRAMES[rows], "episode_index": EPISODES[rows], "index": rows, "task_index": EPISODES[rows] % 2,
    }  # fmt: skip
    if kind == "image":
        cell = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
        for camera in ("observation.images.top", "observation.images.wrist"):
            columns[camera] = pa.array([{"bytes": png(picture(row)), "path": "x.png"} for row in rows.tolist()], cell)
    return pa.table(columns)


def _info(folder: Path, version: str, kind: str, **paths: Any) -> None:
    info = {
        "codebase_version": version, "robot_type": "arm", "total_episodes": len(LENGTHS), "total_frames": COUNT,
        "total_tasks": 2, "chunks_size": 1000, "fps": HZ, "features": _features(kind), **paths,
    }  # fmt: skip
    (folder / "meta").mkdir(parents=True)
    (folder / "meta/info.json").write_text(json.dumps(info))


def lerobot_v3(folder: Path, kind: str = "video", codec: str = "libx264") -> Path:
    """Two parquet files; the top camera's videos are two, those of the wrist camera one."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = "{0}/chunk-{{chunk_index:03d}}/file-{{file_index:03d}}.{1}"
    videos = path.format("videos/{video_key}", "mp4")
    _info(
        folder, "v3.0", kind, data_path=path.format("data", "parquet"), video_path=videos if kind == "video" else None
    )
    places = {"data": [0, 1, 1], "top": [0, 0, 1], "wrist": [0, 0, 0]}
    starts = {"top": [0.0, 0.6, 0.0], "wrist": [0.0, 0.6, 1.5]}
    columns: dict[str, Any] = {
        "episode_index": np.arange(3), "length": LENGTHS, "tasks": [[TASKS[at % 2]] for at in range(3)],
        "data/chunk_index": [0] * 3, "data/file_index": places["data"],
    }  # fmt: skip
    for camera in ("top", "wrist") if kind == "video" else ():
        name = f"videos/observation.images.{camera}"
        columns |= {f"{name}/chunk_index": [0] * 3, f"{name}/file_index": places[camera]}
        columns[f"{name}/from_timestamp"] = starts[camera]
        for number in {*places[camera]}:
            rows = np.flatnonzero(np.isin(EPISODES, np.flatnonzero(np.array(places[camera]) == number)))
            write_video(folder / f"{name}/chunk-000/file-{number:03d}.mp4", rows.tolist(), codec)
    for number in (0, 1):
        rows = np.flatnonzero(np.isin(EPISODES, np.flatnonzero(np.array(places["data"]) == number)))
        file = folder / f"data/chunk-000/file-{number:03d}.parquet"
        file.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(_table(rows, kind), file, row_group_size=5)
    (folder / "meta/episodes/chunk-000").mkdir(parents=True)
    pq.write_table(pa.table(columns), folder / "meta/episodes/chunk-000/file-000.parquet")
    tasks = pa.table({"task_index": [1, 0], "__index_level_0__": [TASKS[1], TASKS[0]]})
    pq.write_table(tasks, folder / "meta/tasks.parquet")
    return folder


def lerobot_v2(folder: Path, kind: str = "video") -> Path:
    """A parquet file, and a video of each camera, for each episode."""
    import pyarrow.parquet as pq

    name = "chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
    _info(folder, "v2.1", kind, video_path=f"videos/{name}")
    entries = [{"episode_index": at, "tasks": [TASKS[at % 2]], "length": LENGTHS[at]} for at in range(3)]
    (folder / "meta/episodes.jsonl").write_text("".join(json.dumps(entry) + "\n" for entry in entries))
    tasks = [{"task_index": at, "task": text} for at, text in enumerate(TASKS)]
    (folder / "meta/tasks.jsonl").write_text("".join(json.dumps(entry) + "\n" for entry in tasks))
    for episode in range(3):
        rows = np.flatnonzero(episode == EPISODES)
        file = folder / f"data/chunk-000/episode_{episode:06d}.parquet"
        file.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(_table(rows, kind), file)
        for camera in ("top", "wrist") if kind == "video" else ():
            video = folder / f"videos/chunk-000/observation.images.{camera}/episode_{episode:06d}.mp4"
            write_video(video, rows.tolist())
    return folder


def jpeg(pixels: Any) -> bytes:
    import io

    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "JPEG", quality=95)
    return stream.getvalue()


def aloha(folder: Path, *, compress: bool = False) -> Path:
    """A file for each episode, written as ALOHA does; its JPEG are what OpenCV makes of an array of RGB."""
    import h5py

    folder.mkdir(parents=True)
    for episode, length in enumerate(LENGTHS):
        rows = np.flatnonzero(episode == EPISODES)
        with h5py.File(folder / f"episode_{episode}.hdf5", "w", rdcc_nbytes=1024**2 * 2) as file:
            file.attrs.update(sim=False, compress=compress)
            images = file.create_group("observations").create_group("images")
            for camera in ("cam_high", "cam_wrist"):
                pixels = [picture(row) for row in rows.tolist()]
                if compress:
                    coded = [np.frombuffer(jpeg(each[:, :, ::-1]), np.uint8) for each in pixels]
                    size = max(map(len, coded)) + 30
                    padded = np.stack([np.pad(each, (0, size - len(each))) for each in coded])
                    images.create_dataset(camera, data=padded, chunks=(1, size))
                else:
                    images.create_dataset(camera, data=np.stack(pixels), chunks=(1, HEIGHT, WIDTH, 3))
            if compress:
                file.create_dataset("compress_len", data=np.zeros((2, length)))
            file["observations"].create_dataset("qpos", data=STATE[rows])
            file["observations"].create_dataset("qvel", data=STATE[rows] * 0)
            file.create_dataset("action", data=ACTION[rows])
    return folder


def robomimic(file: Path) -> Path:
    """All episodes in one file, written as robomimic does; the names of its demos do not sort as text.

    Source: robomimic, ``scripts/dataset_states_to_obs.py`` and ``create_hdf5_filter_key``.
    """
    import h5py

    with h5py.File(file, "w") as opened:
        data = opened.create_group("data")
        for episode, number in enumerate((2, 9, 10)):
            rows = np.flatnonzero(episode == EPISODES)
            demo = data.create_group(f"demo_{number}")
            demo.create_dataset("actions", data=ACTION[rows].astype(np.float64))
            demo.create_dataset("states", data=np.zeros((len(rows), 32)))
            demo.create_dataset("rewards", data=np.zeros(len(rows)))
            demo.create_dataset("dones", data=np.zeros(len(rows), np.int64))
            for group in ("obs", "next_obs"):
                pixels = np.stack([picture(row) for row in rows.tolist()])
                demo.create_dataset(f"{group}/agentview_image", data=pixels, compression="gzip")
                demo.create_dataset(f"{group}/robot0_eef_pos", data=STATE[rows].astype(np.float64))
            demo.attrs.update(model_file="<mujoco/>", num_samples=len(rows))
        settings = {"control_freq": HZ, "camera_names": ["agentview"], "camera_heights": HEIGHT}
        data.attrs["total"] = COUNT
        data.attrs["env_args"] = json.dumps({"env_name": "Lift", "type": 1, "env_kwargs": settings}, indent=4)
        opened["mask/train"] = np.array(["demo_2", "demo_10"], dtype="S")
        opened["mask/valid"] = np.array(["demo_9"], dtype="S")
    return file


def diffusion_zarr(path: Path, version: int = 2, *, zipped: bool = False) -> Path:
    """A replay buffer as Diffusion Policy writes it, by the zarr library; its first row is all zeros, as written."""
    import zarr

    store = zarr.storage.ZipStore(str(path), mode="w") if zipped else zarr.storage.LocalStore(str(path))
    settings = {"config": {"write_empty_chunks": True}}
    root = zarr.open_group(store, mode="w", zarr_format=version)
    data, meta = root.create_group("data"), root.create_group("meta")
    pictures = np.stack([picture(row) for row in range(COUNT)])
    for name, values, chunk in (("img", pictures, 7), ("state", STATE, 5), ("action", ACTION, 8)):
        data.create_array(name, data=values, chunks=(chunk, *values.shape[1:]), **settings)
    meta.create_array("episode_ends", data=np.cumsum(LENGTHS), **settings)
    store.close()
    return path


def image_folder(folder: Path) -> Path:
    """A CSV file and PNG pictures."""
    folder.mkdir(parents=True)
    lines = ["episode,timestamp,cam,state.0,state.1,state.2,action[0],action[1],task"]
    for row in range(COUNT):
        (folder / "cam").mkdir(exist_ok=True)
        (folder / f"cam/{row}.png").write_bytes(png(picture(row)))
        numbers = [*STATE[row].tolist(), *ACTION[row].tolist()]
        cells = [EPISODES[row], FRAMES[row] / HZ, f"cam/{row}.png", *numbers, f'"{TASKS[EPISODES[row] % 2]}, now"']
        lines.append(",".join(map(str, cells)))
    (folder / "log.csv").write_text("\n".join(lines) + "\n")
    return folder


def _tensor(dtype: str, *sizes: int) -> dict[str, Any]:
    shape = {"dimensions": [str(size) for size in sizes]}
    return {"pythonClassName": "x.Tensor", "tensor": {"shape": shape, "dtype": dtype, "encoding": "none"}}


def _dictionary(**features: Any) -> dict[str, Any]:
    return {"pythonClassName": "x.FeaturesDict", "featuresDict": {"features": features}}


def rlds(folder: Path) -> Path:
    """Two files of TFRecord, written by the package tfrecord in the layout of TensorFlow Datasets."""
    from tfrecord.writer import TFRecordWriter

    folder.mkdir(parents=True)
    image = {"pythonClassName": "x.Image", "image": {"shape": {"dimensions": ["48", "64", "3"]}, "dtype": "uint8",
                                                     "encodingFormat": "png"}}  # fmt: skip
    text = {"pythonClassName": "x.Text", "text": {}}
    step = _dictionary(
        observation=_dictionary(image=image, state=_tensor("float32", 3)), action=_tensor("float32", 2),
        is_first=_tensor("bool"), count=_tensor("int64"), language_instruction=text,
    )  # fmt: skip
    features = _dictionary(steps={"pythonClassName": "x.Dataset", "sequence": {"feature": step}},
                           episode_metadata=_dictionary(file_path=text))  # fmt: skip
    (folder / "features.json").write_text(json.dumps(features))
    for shard, episodes in enumerate(((0, 1), (2,))):
        writer = TFRecordWriter(str(folder / f"data-train.tfrecord-0000{shard}-of-00002"))
        for episode in episodes:
            rows = np.flatnonzero(episode == EPISODES)
            coded = [png(picture(row)) for row in rows.tolist()]
            words = [TASKS[episode % 2].encode()] * len(rows)
            writer.write({
                "steps/observation/image": (coded, "byte"), "steps/language_instruction": (words, "byte"),
                "steps/observation/state": (STATE[rows].ravel().tolist(), "float"),
                "steps/action": (ACTION[rows].ravel().tolist(), "float"),
                "steps/is_first": ([int(at == 0) for at in range(len(rows))], "int"),
                "steps/count": ((rows * 1000 - 5).tolist(), "int"),
                "episode_metadata/file_path": (b"x", "byte"),
            })  # fmt: skip
        writer.close()
    return folder


def rosbag(path: Path, kind: str = "mcap", encoding: str = "rgb8", *, gap: bool = False) -> Path:
    """One bag: two cameras at 10 Hz, one of them compressed, joints at 50 Hz, commands at 20 Hz; headers have times.

    Args:
        kind: ``mcap`` or ``sqlite3`` of ROS 2, or ``ros1``.
        gap: whether joints are silent for a second.
    """
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_typestore

    first = kind == "ros1"
    store = get_typestore(Stores.ROS1_NOETIC if first else Stores.ROS2_HUMBLE)
    types = store.types
    plugins = {"mcap": rosbag2.StoragePlugin.MCAP, "sqlite3": rosbag2.StoragePlugin.SQLITE3}
    writer: Any = rosbag1.Writer(path) if first else rosbag2.Writer(path, version=9, storage_plugin=plugins[kind])
    sent: list[tuple[float, str, str, Any]] = []

    def header(time: float) -> Any:
        stamp = types["builtin_interfaces/msg/Time"](sec=100 + int(time), nanosec=round(time % 1 * 1e9))
        return types["std_msgs/msg/Header"](**({"seq": 0} if first else {}), stamp=stamp, frame_id="x")

    for row in range(COUNT):
        time, pixels = row / HZ, picture(row)
        if encoding == "bgr8":
            pixels = pixels[:, :, ::-1]
        lines = np.zeros((HEIGHT, WIDTH * 3 + 5), np.uint8)
        lines[:, : WIDTH * 3] = pixels.reshape(HEIGHT, -1)
        sent.append((time, "/cam/raw", "sensor_msgs/msg/Image", types["sensor_msgs/msg/Image"](
            header=header(time), height=HEIGHT, width=WIDTH, encoding=encoding, is_bigendian=0,
            step=lines.shape[1], data=lines.ravel())))  # fmt: skip
        sent.append((time, "/cam/jpeg", "sensor_msgs/msg/CompressedImage", types["sensor_msgs/msg/CompressedImage"](
            header=header(time + 0.004), format="png", data=np.frombuffer(png(picture(row)), np.uint8))))  # fmt: skip
    for tick in range(COUNT * 5):
        time = tick / 50
        if not gap or not 0.5 < time < 1.5:
            values = {name: np.array([time, -time, 1.0]) for name in ("position", "velocity")}
            joints = types["sensor_msgs/msg/JointState"](
                header=header(time), name=["a", "b", "c"], effort=np.zeros(0), **values
            )
            sent.append((time + 0.03, "/joint_states", "sensor_msgs/msg/JointState", joints))
    for tick in range(COUNT * 2):
        vector = types["geometry_msgs/msg/Vector3"]
        message = types["geometry_msgs/msg/Twist"](
            linear=vector(x=tick / 20, y=2.0, z=0.0), angular=vector(x=0.0, y=0.0, z=1.0)
        )
        sent.append((tick / 20, "/arm/cmd", "geometry_msgs/msg/Twist", message))
    with writer:
        names = {topic: name for _, topic, name, _ in sent}
        topics = {topic: writer.add_connection(topic, name, typestore=store) for topic, name in names.items()}
        serialize = store.serialize_ros1 if first else store.serialize_cdr
        for time, topic, name, message in sorted(sent, key=lambda each: each[0]):
            writer.write(topics[topic], round((100 + time) * 1e9), bytes(serialize(message, name)))
    return path
