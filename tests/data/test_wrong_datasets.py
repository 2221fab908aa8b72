"""Corrupt, truncated and mis-shaped datasets of each format: an error that names the place and the remedy."""

import json
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from tests import _datasets as datasets
from vlatool.data import reader_of
from vlatool.errors import DataError
from vlatool.files.rows import in_memory

for package in ("pyarrow", "av", "h5py", "zarr", "rosbags", "tfrecord"):
    pytest.importorskip(package, reason=f"datasets are written with {package} (extras data and dev)")

Edit = Callable[[Path], Any]


class Row(NamedTuple):
    """One fault: how a dataset is made wrong, and a part of the message."""

    name: str
    says: str
    edit: Edit


def cut(name: str, share: float = 0.6) -> Edit:
    """Cut a file off."""

    def edit(folder: Path) -> None:
        file = folder / name if name else folder
        file.write_bytes(file.read_bytes()[: int(file.stat().st_size * share)])

    return edit


def put(name: str, content: bytes) -> Edit:
    return lambda folder: (folder / name if name else folder).write_bytes(content)


def gone(name: str) -> Edit:
    return lambda folder: (folder / name).unlink()


def flip(name: str, at: float = 0.5, count: int = 64) -> Edit:
    """Overwrite bytes in the middle of a file."""

    def edit(folder: Path) -> None:
        file = folder / name if name else folder
        content = bytearray(file.read_bytes())
        start = int(len(content) * at)
        content[start : start + count] = bytes(255 - byte for byte in content[start : start + count])
        file.write_bytes(content)

    return edit


def table(name: str, change: Callable[[dict[str, Any]], Any]) -> Edit:
    """Write a parquet file again, otherwise."""

    def edit(folder: Path) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        columns = pq.read_table(folder / name).to_pydict()
        pq.write_table(pa.table(change(columns) or columns), folder / name)

    return edit


def h5(change: Callable[[Any], Any], name: str = "episode_1.hdf5") -> Edit:
    def edit(folder: Path) -> None:
        import h5py

        with h5py.File(folder / name if name else folder, "r+") as file:
            change(file)

    return edit


def replaced(group: Any, name: str, values: Any, **settings: Any) -> None:
    del group[name]
    group.create_dataset(name, data=values, **settings)


def lines(change: Callable[[list[str]], Any]) -> Edit:
    def edit(folder: Path) -> None:
        text = (folder / "log.csv").read_text().splitlines()
        (folder / "log.csv").write_text("\n".join(change(text) or text) + "\n")

    return edit


def zarray(name: str, **values: Any) -> Edit:
    def edit(folder: Path) -> None:
        file = folder / name / ".zarray"
        file.write_text(json.dumps({**json.loads(file.read_text()), **values}))

    return edit


def features(**values: Any) -> Edit:
    return put("features.json", json.dumps(values).encode())


def tensor(dtype: str, *sizes: Any) -> Any:
    return {"tensor": {"dtype": dtype, "shape": {"dimensions": [*sizes]}}}


def step(**values: Any) -> Edit:
    inside = {"featuresDict": {"features": values}}
    return features(featuresDict={"features": {"steps": {"sequence": {"feature": inside}}}})


DATA, EPISODES = "data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet"
TOP = "videos/observation.images.top/chunk-000/file-000.mp4"
SHARD = "data-train.tfrecord-00000-of-00002"
LEROBOT = [
    Row("parquet cut", "file-000.parquet cannot be read", cut(DATA)),
    Row("parquet of nothing", "file-000.parquet cannot be read", put(DATA, b"")),
    Row("parquet flipped", "cannot be read", flip(DATA, 0.02, 400)),
    Row("parquet missing", "file-000.parquet not found", gone(DATA)),
    Row("episodes missing", "holds no episodes", lambda folder: shutil.rmtree(folder / "meta/episodes")),
    Row("episodes cut", "cannot be read", cut(EPISODES)),
    Row(
        "an episode not listed",
        "does not list episode 2|holds 10 steps",
        table(EPISODES, lambda c: {k: v[:2] for k, v in c.items()}),
    ),
    Row("no time stamps", "has no column 'timestamp'", table(DATA, lambda c: c.pop("timestamp") and c)),
    Row("no actions", "has no column 'action'", table(DATA, lambda c: c.pop("action") and c)),
    Row("rows of two lengths", "rows of different lengths", table(DATA, lambda c: c["action"].__setitem__(2, [1.0]))),
    Row("a file of another width", "another shape in", table(DATA, lambda c: c.update(action=[[1.0] * 3] * 6))),
    Row(
        "numbers as text",
        "'action' in .* neither numbers nor text|cannot be read|is <U",
        table(DATA, lambda c: c.update(action=[{"x": 1}] * 6)),
    ),
    Row(
        "steps missing",
        "holds 18 steps; its meta/info.json says 19",
        table(DATA, lambda c: {k: v[:-1] for k, v in c.items()}),
    ),
    Row("a task that is not listed", "has the task 9; it lists 2", table(DATA, lambda c: c.update(task_index=[9] * 6))),
    Row(
        "episodes mixed up",
        "holds 7 episodes|says 3",
        table(DATA, lambda c: c.update(episode_index=[0, 1, 0, 1, 0, 1])),
    ),
    Row("video cut", "file-000.mp4 (cannot be read|holds no video)", cut(TOP)),
    Row("video of nothing", "file-000.mp4 cannot be read", put(TOP, b"")),
    Row("video that is text", "file-000.mp4 cannot be read", put(TOP, b"no video at all\n" * 50)),
    Row("video missing", "file-000.mp4 not found", gone(TOP)),
    Row("video of another rate", "has no frame at", lambda folder: datasets.write_video(folder / TOP, range(3))),
    Row("info cut", "info.json is not valid JSON", cut("meta/info.json")),
    Row("info a list", "codebase_version None", put("meta/info.json", b"[]")),
    Row(
        "tasks without text",
        "no column of texts",
        table("meta/tasks.parquet", lambda c: c.pop("__index_level_0__") and c),
    ),
]
LEROBOT_V2 = [
    Row("episodes.jsonl cut", "line 3, is not valid JSON", cut("meta/episodes.jsonl", 0.9)),
    Row("episodes.jsonl missing", "episodes.jsonl not found", gone("meta/episodes.jsonl")),
    Row("a line without an index", "line 1, lacks episode_index", put("meta/episodes.jsonl", b'{"length": 3}\n')),
    Row(
        "parquet of an episode missing",
        "episode_000001.parquet not found",
        gone("data/chunk-000/episode_000001.parquet"),
    ),
    Row(
        "video of an episode missing",
        "episode_000002.mp4 not found",
        gone("videos/chunk-000/observation.images.top/episode_000002.mp4"),
    ),
]
PICTURES = [
    Row(
        "a picture cut",
        "'observation.images.top' in row 2 .* cannot be read",
        table(
            DATA,
            lambda c: c["observation.images.top"].__setitem__(
                2, {"bytes": datasets.png(datasets.picture(2))[:90], "path": ""}
            ),
        ),
    ),
    Row(
        "a picture of another size",
        "in sample 2, and uint8",
        table(
            DATA,
            lambda c: c["observation.images.top"].__setitem__(
                2, {"bytes": datasets.png(datasets.picture(2)[:9]), "path": ""}
            ),
        ),
    ),
    Row(
        "a picture elsewhere",
        "names the picture '../../../etc/passwd', which is not there",
        table(
            DATA, lambda c: c["observation.images.top"].__setitem__(2, {"bytes": None, "path": "../../../etc/passwd"})
        ),
    ),
]
ALOHA = [
    Row("file cut", "episode_1.hdf5 cannot be read", cut("episode_1.hdf5")),
    Row("file of nothing", "episode_1.hdf5 cannot be read", put("episode_1.hdf5", b"")),
    Row("file that is text", "episode_1.hdf5 cannot be read", put("episode_1.hdf5", b"x" * 5000)),
    Row("no action", "has no action or actions; it has observations/", h5(lambda file: file.__delitem__("action"))),
    Row(
        "fewer states",
        "9 steps of 'action', and of others {'observations/qpos': 5}",
        h5(lambda file: replaced(file["observations"], "qpos", datasets.STATE[:5])),
    ),
    Row(
        "a camera missing",
        "'observations/images/cam_high' is in .* and not in",
        h5(lambda file: file["observations/images"].__delitem__("cam_high")),
    ),
    Row(
        "another width",
        r"'observations/qpos' is float32 \[9, 2\] in .*episode_1",
        h5(lambda file: replaced(file["observations"], "qpos", datasets.STATE[:9, :2])),
    ),
    Row(
        "another type",
        "'observations/qpos' is float64",
        h5(lambda file: replaced(file["observations"], "qpos", datasets.STATE[:9].astype(np.float64))),
    ),
    Row(
        "another size of pictures",
        "'observations/images/cam_high' is uint8",
        h5(lambda file: replaced(file["observations/images"], "cam_high", np.zeros((9, 5, 5, 3), np.uint8))),
    ),
    Row(
        "a link to another file",
        "is a link to another file",
        h5(lambda file: file.__setitem__("observations/x", __import__("h5py").ExternalLink("/etc/passwd", "x"))),
    ),
    Row(
        "never written",
        "'observations/y' in .* was never written",
        h5(lambda file: file.create_dataset("observations/y", (9, 3), "f4", chunks=(1, 3))),
    ),
    Row(
        "written in part",
        "has 1 of 9 chunks",
        h5(lambda file: file.create_dataset("observations/y", (9, 3), "f4", chunks=(1, 3)).__setitem__(0, 1.0)),
    ),
    Row(
        "a row beyond the limit",
        "the limit 'picture_bytes' allows",
        h5(lambda file: file.create_dataset("observations/y", (9, 1 << 40), "f4", chunks=(1, 1024))),
    ),
]
ALOHA_JPEG = [
    Row(
        "a JPEG of zeros",
        "'observations/images/cam_high' in step 4 of .*episode_1.* cannot be read",
        h5(lambda file: file["observations/images/cam_high"].__setitem__(4, 0)),
    ),
    Row(
        "a JPEG cut",
        "in step 4 of .* cannot be read",
        h5(lambda file: file["observations/images/cam_high"].__setitem__((4, slice(400, None)), 0)),
    ),
]
ROBOMIMIC = [
    Row(
        "no demos",
        "holds no episodes",
        h5(lambda file: [file["data"].__delitem__(name) for name in list(file["data"])], ""),
    ),
    Row(
        "a demo without actions",
        r"\(data/demo_9\) has no action or actions",
        h5(lambda file: file["data/demo_9"].__delitem__("actions"), ""),
    ),
    Row("cut", "cannot be read", cut("")),
]
ZARR = [
    Row("a chunk missing", "has 2 of 3 chunks; the others are missing", gone("data/img/1.0.0.0")),
    Row("a chunk of states missing", "'state' in .* has 3 of 4 chunks", gone("data/state/2.0")),
    Row("a chunk cut", "cannot be read", cut("data/img/1.0.0.0", 0.3)),
    Row("no ends", "has no meta/episode_ends", lambda folder: shutil.rmtree(folder / "meta/episode_ends")),
    Row("no data", r"has no data/", lambda folder: shutil.rmtree(folder / "data")),
    Row("pickle", "is coded by 'pickle', which is not read", zarray("data/state", filters=[{"id": "pickle"}])),
    Row(
        "an unknown codec",
        "is coded by 'imagecodecs_jpegxl'",
        zarray("data/img", compressor={"id": "imagecodecs_jpegxl"}),
    ),
    Row("metadata cut", "is not valid JSON", cut("data/img/.zarray")),
    Row(
        "another number of steps",
        r"has the shape \[25, 3\]; its episodes have 19 steps",
        zarray("data/state", shape=[25, 3]),
    ),
    Row("a chunk of another size", "cannot be read", zarray("data/img", chunks=[19, 48, 64, 4])),
    Row(
        "a row beyond the limit",
        "the limit 'picture_bytes' allows",
        zarray("data/img", shape=[19, 1 << 20, 1 << 20, 3]),
    ),
]
ZARR_ZIP = [
    Row("zip cut", "cannot be read", cut("")),
    Row("zip of nothing", "cannot be read", put("", b"")),
]
RLDS = [
    Row("file cut", "record 1 of .* is truncated", cut(SHARD, 0.9)),
    Row("data flipped", "record [01] of .* is corrupt: its checksum", flip(SHARD)),
    Row("length flipped", "record 0 of .* is corrupt: its checksum", flip(SHARD, 0.0, 4)),
    Row("half a head", "record 0 of .* is truncated", put(SHARD, b"1234567")),
    Row("features cut", "features.json is not valid JSON", cut("features.json")),
    Row("no steps", "describes no steps", features(featuresDict={"features": {}})),
    Row(
        "another width",
        r"'action' in record 0 .* has 12 values; 6 steps take 18",
        step(is_first=tensor("bool"), action=tensor("float32", "3")),
    ),
    Row(
        "a missing value",
        "'torque' in record 0 .* is missing",
        step(is_first=tensor("bool"), torque=tensor("float32", "3")),
    ),
    Row("an unknown type", "has the type float99", step(is_first=tensor("bool"), action=tensor("float99", "2"))),
    Row("a negative size", "has the type float32", step(is_first=tensor("bool"), action=tensor("float32", "-2"))),
    Row(
        "not an example",
        "record 0 of .* is not a tf.train.Example|has no steps",
        lambda folder: write_record(folder / SHARD, b"\x0a\xff\xff\xff\xff\x7f"),
    ),
]
FOLDER = [
    Row("no lines", "holds no samples", put("log.csv", b"episode,action\n")),
    Row(
        "a cell missing",
        "line 4, has 8 cells; it has 9 columns",
        lines(lambda text: [*text[:3], text[3].partition(",")[2].replace(", now", " now"), *text[4:]]),
    ),
    Row(
        "a word for a number",
        "'state.1' in .*, line 5, is 'x', not a number",
        lines(lambda text: [*text[:4], text[4].replace(",-3.0,", ",x,"), *text[5:]]),
    ),
    Row("a picture missing", "line 7, names 'cam/5.png', which is not a picture in the folder", gone("cam/5.png")),
    Row(
        "a picture outside",
        "names '/etc/passwd', which is not a picture",
        lines(lambda text: [each.replace("cam/3.png", "/etc/passwd") for each in text]),
    ),
    Row("a picture cut", "cam/5.png cannot be read", cut("cam/5.png", 0.5)),
    Row(
        "a picture of another size",
        "in sample 5, and uint8|is uint8",
        put("cam/5.png", datasets.png(datasets.picture(5)[:20])),
    ),
    Row(
        "two columns of one name",
        "two of one name",
        lines(lambda text: [text[0].replace("state.1", "state.0"), *text[1:]]),
    ),
    Row(
        "an element missing",
        r"lacks an element of 'state'; it has \[0, 2, 5\]",
        lines(lambda text: [text[0].replace("state.1", "state.5"), *text[1:]]),
    ),
    Row(
        "an episode that comes back",
        "comes back to an episode that had ended",
        lines(lambda text: [*[text[0], *text[:0:-1][-5:], *text[1:]][: len(text)], text[1]]),
    ),
    Row("half an episode", "must be whole numbers", lines(lambda text: [text[0], "0.5" + text[1][1:], *text[2:]])),
    Row("not text", "log.csv cannot be read", put("log.csv", b"\xff\xfe\x00episode\n" * 9)),
    Row("two tables", "holds 2 CSV files: log.csv, other.csv", put("other.csv", b"a\n1\n")),
]
BAG = [
    Row("cut", "cannot be read|has no", lambda folder: cut("")(next(folder.glob("*.mcap")))),
    Row("of nothing", "cannot be read", lambda folder: next(folder.glob("*.mcap")).write_bytes(b"")),
    Row("flipped", "cannot be read", lambda folder: flip("", 0.5, 2000)(next(folder.glob("*.mcap")))),
    Row("metadata cut", "cannot be read", cut("metadata.yaml", 0.3)),
    Row("metadata of nothing", "cannot be read", put("metadata.yaml", b"")),
    Row("no storage", "cannot be read", lambda folder: next(folder.glob("*.mcap")).unlink()),
]
BAG_SQLITE = [
    Row("cut", "cannot be read", lambda folder: cut("", 0.5)(next(folder.glob("*.db3")))),
    Row("text", "cannot be read", lambda folder: next(folder.glob("*.db3")).write_bytes(b"x" * 9999)),
]
BAG_1 = [
    Row("cut", "cannot be read", cut("")),
    Row("of nothing", "cannot be read", put("", b"")),
    Row("another magic", "cannot be read", flip("", 0.0, 13)),
]
FORMATS: dict[str, tuple[str, Callable[[Path], Path], list[Row]]] = {
    "lerobot": ("data", datasets.lerobot_v3, LEROBOT),
    "lerobot 2": ("data", datasets.lerobot_v2, LEROBOT_V2),
    "lerobot pictures": ("data", lambda path: datasets.lerobot_v3(path, "image"), PICTURES),
    "aloha": ("data", datasets.aloha, ALOHA),
    "aloha jpeg": ("data", lambda path: datasets.aloha(path, compress=True), ALOHA_JPEG),
    "robomimic": ("data.hdf5", datasets.robomimic, ROBOMIMIC),
    "zarr": ("data", datasets.diffusion_zarr, ZARR),
    "zarr zip": ("data.zarr.zip", lambda path: datasets.diffusion_zarr(path, zipped=True), ZARR_ZIP),
    "rlds": ("data", datasets.rlds, RLDS),
    "folder": ("data", datasets.image_folder, FOLDER),
    "bag": ("data", datasets.rosbag, BAG),
    "bag sqlite3": ("data", lambda path: datasets.rosbag(path, "sqlite3"), BAG_SQLITE),
    "bag of ROS 1": ("data.bag", lambda path: datasets.rosbag(path, "ros1"), BAG_1),
}
CASES = [(kind, row) for kind, (_, _, rows) in FORMATS.items() for row in rows]


def write_record(file: Path, content: bytes) -> None:
    import google_crc32c

    def checksum(part: bytes) -> bytes:
        value = google_crc32c.value(part)
        return struct.pack("<I", ((value >> 15 | value << 17) + 0xA282EAD8) & 0xFFFFFFFF)

    head = struct.pack("<Q", len(content))
    file.write_bytes(head + checksum(head) + content + checksum(content))


@pytest.fixture(scope="module")
def originals(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return {}


def copy_of(kind: str, originals: dict[str, Path], factory: pytest.TempPathFactory, target: Path) -> Path:
    name, write, _ = FORMATS[kind]
    if kind not in originals:
        originals[kind] = write(factory.mktemp("original") / name)
    if originals[kind].is_dir():
        return Path(shutil.copytree(originals[kind], target / name))
    return Path(shutil.copyfile(originals[kind], target / name))


def read_all(path: Path) -> None:
    """Read every step of every column."""
    for values in reader_of(path).steps(path).columns.values():
        in_memory(values)


def test_there_are_sixty_and_more():
    assert len(CASES) >= 60
    assert len({(kind, row.name) for kind, row in CASES}) == len(CASES)


@pytest.mark.parametrize(("kind", "row"), CASES, ids=[f"{kind}: {row.name}" for kind, row in CASES])
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_what_is_wrong_is_named(kind: str, row: Row, originals: Any, tmp_path: Path, tmp_path_factory: Any):
    path = copy_of(kind, originals, tmp_path_factory, tmp_path)
    row.edit(path)
    with pytest.raises(DataError, match=row.says) as caught:
        read_all(path)
    assert caught.value.fix
    assert str(path) in caught.value.message or "observation" in caught.value.message


@pytest.mark.parametrize("kind", FORMATS)
def test_and_what_is_right_is_read(kind: str, originals: Any, tmp_path: Path, tmp_path_factory: Any):
    read_all(copy_of(kind, originals, tmp_path_factory, tmp_path))
