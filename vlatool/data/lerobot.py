"""Datasets of LeRobot, versions 2.0 to 3.0: parquet with the steps, and videos or pictures of each camera."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from vlatool.data._lazy_rows import LazyRows, text_rows
from vlatool.data._parquet import COPY_AGAIN, ParquetPictures, Table, open_parquet, read_table
from vlatool.data._pictures import stack_pictures
from vlatool.data._recording import Values
from vlatool.data._step_reader import StepReader
from vlatool.data._steps import Steps
from vlatool.data._video import VideoFrames
from vlatool.errors import DataError
from vlatool.files.json import read_json
from vlatool.files.limits import limit
from vlatool.registry import Claim

Array = NDArray[Any]
INFO = Path("meta/info.json")
BOOKKEEPING = ("index", "frame_index", "episode_index", "task_index", "timestamp")
VERSIONS = ("v2.0", "v2.1", "v3.0")
FIELD = re.compile(r"\{(\w+)(?::0?(\d)d)?\}")
V3_DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
V3_VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
V2_DATA = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
V2_VIDEO = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
Clips = tuple[list[Path], Array]
"""Of each episode: the video that holds it, and the time at which it begins there, in seconds."""


class LerobotDataset(StepReader):
    """Reads directories that LeRobot recorded: ``meta/info.json`` says what is where."""

    needs: ClassVar[str] = "a directory with meta/info.json, of LeRobot"

    @classmethod
    def claims(cls, path: Path) -> Claim:
        """Claim a directory with ``meta/info.json``."""
        return Claim.CERTAIN if (path / INFO).is_file() else Claim.NONE

    def steps(self, path: Path) -> Steps:
        """Return what a dataset holds.

        Raises:
            DataError: when it is corrupt, incomplete, or of another version.
        """
        info = _read_info(path)
        layout = _Layout(path, info)
        episodes = _episodes_v3(layout) if layout.version == "v3.0" else _episodes_v2(layout)
        return _steps(layout, episodes)


class _Layout:
    """What ``meta/info.json`` says.

    Args:
        info: its content.
    """

    def __init__(self, path: Path, info: Mapping[str, Any]) -> None:
        self.path = path
        self.version = str(info.get("codebase_version"))
        self.features: dict[str, Mapping[str, Any]] = _mapping(path, info, "features")
        self.hz = _number(path, info, "fps")
        self.episodes, self.frames = (int(_number(path, info, key)) for key in ("total_episodes", "total_frames"))
        self._chunk = int(_number(path, {"chunks_size": 1000, **info}, "chunks_size"))
        newest = self.version == "v3.0"
        self._data = str(info.get("data_path") or (V3_DATA if newest else V2_DATA))
        self._video = str(info.get("video_path") or (V3_VIDEO if newest else V2_VIDEO))

    def cameras(self, kind: str) -> list[str]:
        """Return the features of one kind: ``video`` or ``image``."""
        return [name for name, feature in self.features.items() if feature.get("dtype") == kind and not _depth(feature)]

    def depth_maps(self) -> list[str]:
        """Return the features that are depths, coded as the colours of a video: they are not read."""
        return [name for name, feature in self.features.items() if _depth(feature)]

    def data_file(self, **fields: int) -> Path:
        """Return a parquet file with steps."""
        return self._file(self._data, fields)

    def video_file(self, camera: str, **fields: int) -> Path:
        """Return a video of a camera."""
        return self._file(self._video, {"video_key": camera, **fields})

    def _file(self, pattern: str, fields: Mapping[str, Any]) -> Path:
        """Fill in a pattern: names and numbers alone, and no file outside the dataset."""
        if "episode_index" in fields:
            fields = {**fields, "episode_chunk": fields["episode_index"] // self._chunk}

        def fill(match: re.Match[str]) -> str:
            if match[1] not in fields:
                raise DataError(f"{self.path / INFO} names files by '{match[1]}', which is unknown.", COPY_AGAIN)
            return f"{fields[match[1]]:0{match[2]}d}" if match[2] else str(fields[match[1]])

        name = FIELD.sub(fill, pattern)
        if name.startswith("/") or ".." in name.split("/"):
            raise DataError(f"{self.path / INFO} names a file outside the dataset: {name[:80]}.", COPY_AGAIN)
        return self.path / name


def _depth(feature: Mapping[str, Any]) -> bool:
    info = feature.get("info")
    return isinstance(info, Mapping) and bool(info.get("is_depth_map") or info.get("video.is_depth_map"))


@dataclass(frozen=True)
class _Episodes:
    """Where the episodes are.

    Args:
        files: parquet files in order.
        clips: camera -> video and start of each episode, by its index.
        texts: the tasks.
    """

    files: list[Path]
    clips: dict[str, Callable[[Array], Clips]]
    texts: list[str]


def _read_info(path: Path) -> Mapping[str, Any]:
    file = path / INFO
    with file.open("rb") as stream:
        content = stream.read(limit("manifest_bytes"))
    info = read_json(content, str(file), DataError, COPY_AGAIN)
    version = info.get("codebase_version") if isinstance(info, dict) else None
    if version not in VERSIONS:
        raise DataError(
            f"{file} has the codebase_version {version!r:.40}; read are {', '.join(VERSIONS)}.",
            "convert the dataset with LeRobot: python -m lerobot.scripts.convert_dataset_v21_to_v30",
        )
    return dict(info)


def _mapping(path: Path, info: Mapping[str, Any], key: str) -> dict[str, Mapping[str, Any]]:
    value = info.get(key)
    if not isinstance(value, dict) or not all(isinstance(item, dict) for item in value.values()):
        raise DataError(f"{path / INFO} has no mapping '{key}'.", COPY_AGAIN)
    return value


def _number(path: Path, info: Mapping[str, Any], key: str) -> float:
    value = info.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < 1e12:
        raise DataError(f"{path / INFO} has the {key} {value!r:.40}; wanted a number above 0.", COPY_AGAIN)
    return value


def _numbered_files(folder: Path, what: str) -> list[Path]:
    files = sorted(folder.glob("chunk-*/file-*.parquet"))
    if not files:
        raise DataError(f"{folder} holds no {what}.", COPY_AGAIN)
    return files


def _episodes_v3(layout: _Layout) -> _Episodes:
    videos = [f"videos/{camera}/{field}" for camera in layout.cameras("video") for field in
              ("chunk_index", "file_index", "from_timestamp")]  # fmt: skip
    names = ["episode_index", "data/chunk_index", "data/file_index", *videos]
    tables = [read_table(file, names) for file in _numbered_files(layout.path / "meta/episodes", "episodes")]
    columns = {name: np.concatenate([table[name] for table in tables]) for name in names}
    places = sorted({*zip(*(columns[f"data/{field}_index"].tolist() for field in ("chunk", "file")), strict=True)})
    files = [layout.data_file(chunk_index=chunk, file_index=number) for chunk, number in places]
    row_of = {int(episode): row for row, episode in enumerate(columns["episode_index"])}

    def clips_of(camera: str) -> Callable[[Array], Clips]:
        def clips(episodes: Array) -> Clips:
            rows = [_row(layout, row_of, int(episode)) for episode in episodes]
            chunks, numbers, starts = (
                columns[f"videos/{camera}/{field}"][rows] for field in ("chunk_index", "file_index", "from_timestamp")
            )
            places = zip(chunks.tolist(), numbers.tolist(), strict=True)
            return [layout.video_file(camera, chunk_index=int(a), file_index=int(b)) for a, b in places], starts

        return clips

    return _Episodes(files, {name: clips_of(name) for name in layout.cameras("video")}, _tasks_v3(layout))


def _row(layout: _Layout, row_of: Mapping[int, int], episode: int) -> int:
    if episode not in row_of:
        raise DataError(f"{layout.path}/meta/episodes does not list episode {episode}, which has steps.", COPY_AGAIN)
    return row_of[episode]


def _tasks_v3(layout: _Layout) -> list[str]:
    file = layout.path / "meta/tasks.parquet"
    if not file.exists():
        return []
    table = read_table(file)
    texts = [values for values in table.columns.values() if values.dtype.kind == "U"]
    if not texts:
        raise DataError(f"{file} has no column of texts.", COPY_AGAIN)
    return [str(texts[0][at]) for at in np.argsort(table["task_index"])]


def _json_lines(file: Path, *keys: str) -> Iterator[dict[str, Any]]:
    """Yield the objects of a file, one in each line."""
    if not file.is_file():
        raise DataError(f"{file} not found.", COPY_AGAIN)
    with file.open("rb") as stream:
        for number, line in enumerate(iter(lambda: stream.readline(limit("manifest_bytes")), b""), 1):
            if not line.strip():
                continue
            value = read_json(line, f"{file}, line {number},", DataError, COPY_AGAIN)
            if not isinstance(value, dict) or not all(type(value.get(key)) is int for key in keys):
                raise DataError(f"{file}, line {number}, lacks {' or '.join(keys)}.", COPY_AGAIN)
            yield value


def _episodes_v2(layout: _Layout) -> _Episodes:
    listed = [entry["episode_index"] for entry in _json_lines(layout.path / "meta/episodes.jsonl", "episode_index")]
    tasks = _json_lines(layout.path / "meta/tasks.jsonl", "task_index")
    texts = [str(entry.get("task", "")) for entry in sorted(tasks, key=lambda entry: int(entry["task_index"]))]

    def clips_of(camera: str) -> Callable[[Array], Clips]:
        def clips(episodes: Array) -> Clips:
            return [layout.video_file(camera, episode_index=int(episode)) for episode in episodes], np.zeros(
                len(episodes)
            )

        return clips

    files = [layout.data_file(episode_index=episode) for episode in sorted(listed)]
    return _Episodes(files, {name: clips_of(name) for name in layout.cameras("video")}, texts)


def _steps(layout: _Layout, where: _Episodes) -> Steps:
    pictures = {*layout.cameras("video"), *layout.cameras("image"), *layout.depth_maps()}
    values = [name for name in layout.features if name not in {*pictures, *BOOKKEEPING}]
    wanted = [*values, "episode_index", "timestamp", *(["task_index"] if "task_index" in layout.features else [])]
    tables = [read_table(file, wanted) for file in where.files]
    columns = {name: _joined(tables, name) for name in wanted}
    episodes = columns["episode_index"].astype(np.int64)
    _check_counts(layout, episodes)
    times = columns["timestamp"].reshape(-1).astype(np.float64)
    result: dict[str, Values] = {}
    for camera in layout.cameras("video"):
        result[camera] = _video_rows(layout, camera, where.clips[camera], episodes, times)
    for camera in layout.cameras("image"):
        result[camera] = _picture_rows(layout, camera, where.files, [table.rows for table in tables])
    result |= {name: columns[name] for name in values}
    tasks = columns["task_index"].reshape(-1).astype(np.int64) if "task_index" in layout.features else None
    if tasks is not None and where.texts:
        if tasks.min(initial=0) < 0 or tasks.max(initial=0) >= len(where.texts):
            raise DataError(f"{layout.path} has the task {tasks.max()}; it lists {len(where.texts)}.", COPY_AGAIN)
        result["task"] = text_rows(where.texts, tasks, f"'task' in {layout.path}")
    notes = tuple(f"'{name}' is a depth map in a video, which is not read" for name in layout.depth_maps())
    action = "action" if "action" in result else ""
    return Steps(layout.path, result, episodes, times, action, layout.hz, tasks, notes=notes)


def _joined(tables: list[Table], name: str) -> Array:
    parts = [table[name] for table in tables if table.rows]
    if len({part.shape[1:] for part in parts}) > 1:
        raise DataError(f"'{name}' has another shape in {tables[-1].path} than in {tables[0].path}.", COPY_AGAIN)
    return np.concatenate(parts) if parts else np.empty(0)


def _check_counts(layout: _Layout, episodes: Array) -> None:
    """Refuse a dataset of which a part is missing, and one whose episodes are torn apart."""
    runs = 1 + int(np.count_nonzero(np.diff(episodes))) if len(episodes) else 0
    for what, got, said in (("steps", len(episodes), layout.frames), ("episodes", runs, layout.episodes)):
        if got != said:
            raise DataError(f"{layout.path} holds {got} {what}; its meta/info.json says {said}.", COPY_AGAIN)


def _video_rows(
    layout: _Layout, camera: str, clips: Callable[[Array], Clips], episodes: Array, times: Array
) -> LazyRows:
    names, at = np.unique(episodes, return_inverse=True)
    files, starts = clips(names)
    if missing := next((file for file in dict.fromkeys(files) if not file.is_file()), None):
        raise DataError(f"{missing} not found.", "copy the dataset again, with its videos")
    frames = VideoFrames(0.5 / layout.hz)

    def fetch(rows: NDArray[np.intp]) -> Array:
        pictures = [frames.at(files[at[row]], float(starts[at[row]] + times[row])) for row in rows]
        return stack_pictures(pictures, where, rows)

    where = f"'{camera}' in {layout.path}"
    return LazyRows(fetch, (len(episodes), *frames.shape(files[0])), np.dtype(np.uint8), where)


def _picture_rows(layout: _Layout, camera: str, files: list[Path], counts: list[int]) -> LazyRows:
    for file in files[:1]:
        if camera not in open_parquet(file).schema_arrow.names:
            raise DataError(f"{file} has no column '{camera}'.", COPY_AGAIN)
    pictures = ParquetPictures(files, counts, camera, layout.path)
    first = pictures.fetch(np.zeros(1, np.intp))
    return LazyRows(pictures.fetch, (sum(counts), *first.shape[1:]), first.dtype, f"'{camera}' in {layout.path}")
