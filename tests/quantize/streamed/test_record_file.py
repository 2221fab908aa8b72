"""The streaming writer: order, processes, journal, kills, full disks; and the reader of shards."""

import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from vlatool.bundle.bundle import hash_file
from vlatool.errors import GraphError, OutputError, SourceError
from vlatool.files import resumable_work
from vlatool.files.resumable_work import work_directory
from vlatool.quantize.streamed import record_file
from vlatool.quantize.streamed._block_quantization import BlockFormat
from vlatool.quantize.streamed._graph_rewrite import Task, copy_task, weight_task
from vlatool.quantize.streamed._journal import DATA, JOURNAL
from vlatool.quantize.streamed._worker import serve
from vlatool.quantize.streamed.record_file import write_records
from vlatool.quantize.streamed.records import Record
from vlatool.quantize.streamed.tensor_jobs import Job, records_for
from vlatool.stage.base import OnProgress
from vlatool.weights.shards import Reader, StoredTensor, fingerprint, read_header, read_shards, stored_array

FORM = BlockFormat()


class LayerLike:
    """What a task wants to know of a layer."""

    class node:
        name = "layer/MatMul"

    def __init__(self, name: str, rows: int, columns: int) -> None:
        self.weight, self.rows, self.columns, self.output_first = name, rows, columns, True


@pytest.fixture
def shard(tmp_path: Path) -> Path:
    random = np.random.default_rng(0)
    weights = {f"layer.{number}": random.standard_normal((64, 128), np.float32) for number in range(6)}
    weights["table"] = random.standard_normal((50, 16), np.float32)
    save_file(weights, tmp_path / "model.safetensors")
    return tmp_path / "model.safetensors"


def records(shard: Path) -> list[Record]:
    found = []
    for tensor in sorted(read_header(shard), key=lambda each: each.name):
        quantized = tensor.name.startswith("layer")
        layer = LayerLike(tensor.name, 128, 64)
        task: Task = (
            weight_task(layer, tensor, FORM, "ort", False) if quantized else copy_task(tensor.name, tensor, True)
        )
        found += records_for(task, FORM, "searched", FORM.largest_error)
    return found


def silent(_what: str, _share: float | None) -> None:
    pass


def write(parts: list[Record], place: Path, processes: int = 0, plan: str = "a", tell=silent) -> record_file.RecordFile:
    with work_directory(place):
        return write_records(parts, plan, place, processes, tell)


@pytest.fixture
def reference(shard, tmp_path) -> record_file.RecordFile:
    return write(records(shard), tmp_path / "work" / "reference")


def test_the_file_is_hashed_while_it_is_written(reference):
    assert reference.sha256 == hash_file(reference.path)
    assert reference.bytes == reference.path.stat().st_size
    assert reference.bytes % 4096 == 0
    assert reference.resumed == 0
    errors = [note["error"] for note in reference.notes if "error" in note]
    assert len(errors) == 6
    assert all(0.05 < error < 0.1 for error in errors)


def test_processes_give_the_same_bytes(shard, reference, tmp_path):
    told: list[float | None] = []
    made = write(records(shard), tmp_path / "work" / "many", 2, tell=lambda _what, share: told.append(share))
    assert (made.sha256, made.notes) == (reference.sha256, reference.notes)
    assert told == sorted(told)
    assert told[-1] == 1.0


def test_progress_says_quantized_of_what_is_quantized_alone(shard, tmp_path):
    told: list[str] = []
    write(records(shard), tmp_path / "work" / "told", tell=lambda what, _share: told.append(what))
    assert told == [*["quantized layer/MatMul"] * 6, "copied table"]


class Stop(Exception):
    """Ends a run from within."""


def stopping(after: int) -> OnProgress:
    left = iter(range(after))

    def tell(_what: str, _share: float | None) -> None:
        if next(left, None) is None:
            raise Stop

    return tell


@pytest.fixture
def interrupted(shard, tmp_path) -> Path:
    """A work directory whose run ended after five of seven records."""
    place = tmp_path / "work" / "interrupted"
    with pytest.raises(Stop):
        write(records(shard), place, tell=stopping(4))
    return place


def test_a_run_goes_on_after_what_is_finished(shard, reference, interrupted):
    made = write(records(shard), interrupted)
    assert made.resumed == 5
    assert (made.sha256, made.notes) == (reference.sha256, reference.notes)
    assert write(records(shard), interrupted).resumed == 7


def cut_journal(place: Path) -> int:
    text = (place / JOURNAL).read_bytes()
    (place / JOURNAL).write_bytes(text[:-9])
    return 4


def cut_data(place: Path) -> int:
    os.truncate(place / DATA, (place / DATA).stat().st_size - 5000)
    return 4


def change_data(place: Path) -> int:
    with (place / DATA).open("r+b") as stream:
        stream.seek(10_000)
        stream.write(b"\x00\xff\x13")
    return 1


def lose_data(place: Path) -> int:
    (place / DATA).unlink()
    return 0


def add_garbage(place: Path) -> int:
    with (place / DATA).open("ab") as stream:
        stream.write(b"x" * 5000)
    with (place / JOURNAL).open("ab") as stream:
        stream.write(b'{"sha256": "0", "note": {}}\n["no"]\n')
    return 5


@pytest.mark.parametrize("damage", [cut_journal, cut_data, change_data, lose_data, add_garbage])
def test_only_records_that_are_whole_count(shard, reference, interrupted, damage):
    wanted = damage(interrupted)
    made = write(records(shard), interrupted)
    assert made.resumed == wanted
    assert made.sha256 == reference.sha256 == hash_file(made.path)


def test_work_of_another_plan_is_thrown_away(shard, reference, interrupted):
    made = write(records(shard), interrupted, plan="b")
    assert (made.resumed, made.sha256) == (0, reference.sha256)


@pytest.fixture
def little_room() -> Iterator[int]:
    """A limit on file sizes, which child processes inherit; a write beyond it fails as on a full disk."""
    limit = 50_000
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    yield limit
    resource.setrlimit(resource.RLIMIT_FSIZE, before)
    signal.signal(signal.SIGXFSZ, handler)


@pytest.mark.parametrize("processes", [0, 2])
def test_a_full_disk_keeps_what_is_finished(shard, reference, tmp_path, request, processes):
    place = tmp_path / "work" / "full"
    request.getfixturevalue("little_room")
    with pytest.raises(OutputError, match=r"limit on file sizes; [1-6] of 7 parts are finished and kept") as caught:
        write(records(shard), place, processes)
    assert "run the same command again" in caught.value.fix
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
    made = write(records(shard), place)
    assert made.resumed > 0
    assert made.sha256 == reference.sha256


def test_an_error_in_a_process_is_the_error_here(shard, tmp_path):
    random = np.random.default_rng(0).standard_normal((64, 128), np.float32)
    random[1, 2] = np.nan
    save_file({"layer.0": random}, tmp_path / "nan.safetensors")
    for processes in (0, 1):
        with pytest.raises(GraphError, match=r"'layer\.0' in nan\.safetensors holds NaN or infinity"):
            write(records(tmp_path / "nan.safetensors"), tmp_path / "work" / str(processes), processes)


def test_a_loss_beyond_the_bits_is_an_error(shard, tmp_path):
    tensor = next(each for each in read_header(shard) if each.name == "layer.0")
    task = weight_task(LayerLike("layer.0", 128, 64), tensor, FORM, "ort", False)
    with pytest.raises(GraphError, match=r"Quantizing 'layer\.0' .* loses 0\.0\d+ of its norm; allowed: 0\.01"):
        write(records_for(task, FORM, "rtn", 0.01), tmp_path / "work" / "a")


def test_a_worker_ends_with_its_parent(tmp_path):
    worker = subprocess.Popen(
        [sys.executable, "-m", "vlatool.quantize.streamed._worker"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert worker.stdin is not None
    assert worker.stdout is not None
    worker.stdin.close()
    assert worker.wait(timeout=60) == 0
    worker.stdout.close()


def test_a_job_is_the_same_after_a_journey(shard, tmp_path):
    part = records(shard)[0]
    assert isinstance(part.fill, Job)
    assert Job.from_json(part.fill.to_json()) == part.fill
    request = {"job": part.fill.to_json(), "size": part.size, "file": str(tmp_path / "data"), "offset": 4096}
    with (tmp_path / "replies").open("w+") as replies:
        serve(iter([json.dumps(request)]), replies)  # type: ignore[arg-type]
        replies.seek(0)
        assert json.loads(replies.read())["note"]["tensor"] == "layer.0"
    assert (tmp_path / "data").stat().st_size == 4096 + part.size


def test_forgotten_work_is_swept(shard, tmp_path):
    old, new = tmp_path / "work" / "old", tmp_path / "work" / "new"
    for place in (old, new):
        write(records(shard), place)
    past = time.time_ns() // 10**9 - resumable_work.MAX_AGE_S - 60
    os.utime(old / "lock", (past, past))
    write(records(shard), tmp_path / "work" / "third")
    assert not old.exists()
    assert new.exists()


def test_parts_of_tensors_are_read(shard):
    tensor = next(each for each in read_header(shard) if each.name == "layer.3")
    raw = shard.read_bytes()[tensor.offset : tensor.offset + tensor.nbytes]
    with Reader() as reader:
        assert reader.read(tensor, 0, tensor.nbytes).tobytes() == raw
        assert reader.read(tensor, 1000, 77).tobytes() == raw[1000:1077]
        held = stored_array("x", np.arange(6, dtype=np.int64).reshape(2, 3), shard)
        assert (held.dtype, held.shape, held.nbytes) == ("I64", (2, 3), 48)
        assert reader.read(held, 8, 8).view(np.int64).tolist() == [1]
        beyond = StoredTensor("x", shard, shard.stat().st_size - 10, "U8", (100,))
        with pytest.raises(SourceError, match="cut off: it ends within 'x'"):
            reader.read(beyond, 0, 100)


def test_large_reads_past_the_page_cache(tmp_path):
    content = np.random.default_rng(0).integers(0, 256, 3_000_001, np.uint8)
    content.tofile(tmp_path / "large")
    with Reader() as reader:
        tensor = StoredTensor("large", tmp_path / "large", 0, "U8", (len(content),))
        np.testing.assert_array_equal(reader.read(tensor, 5, 2_999_000), content[5 : 5 + 2_999_000])
        np.testing.assert_array_equal(reader.read(tensor, 1_000_000, 2_000_001), content[1_000_000:])


def header(entries: object) -> bytes:
    text = json.dumps(entries).encode()
    return len(text).to_bytes(8, "little") + text


def entry(dtype: str = "F32", shape: tuple[int, ...] = (2,), begin: int = 0, end: int = 8) -> dict[str, object]:
    return {"x": {"dtype": dtype, "shape": list(shape), "data_offsets": [begin, end]}}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not a safetensors file, or is cut off: 0 bytes"),
        (b"PK\x03\x04 this is something else", "not a safetensors file, or is cut off"),
        ((99).to_bytes(8, "little") + b"{}", "cannot hold a header of 99"),
        ((2).to_bytes(8, "little") + b"{]", "damaged safetensors header"),
        (header([1]), "it is not a mapping"),
        (header({"x": {"dtype": "F32"}}), "damaged safetensors header at 'x'"),
        (header(entry("F4")) + bytes(8), "holds 'x' as F4; known dtypes"),
        (header(entry(end=4)) + bytes(8), "cannot take 4 bytes"),
        (header(entry(shape=(-2,), end=-8)) + bytes(8), "cannot take"),
        (header(entry()) + bytes(7), "is cut off: it has .* bytes, 'x' ends at"),
    ],
)
def test_a_damaged_shard_is_refused(tmp_path, content, message):
    (tmp_path / "a.safetensors").write_bytes(content)
    with pytest.raises(SourceError, match=message):
        read_shards(tmp_path, "*.safetensors")


def test_shards_and_their_index(tmp_path, shard):
    with pytest.raises(SourceError, match=r"No file in .* matches 'weights: \*\.bin'"):
        read_shards(tmp_path, "*.bin")
    index = tmp_path / "model.safetensors.index.json"
    index.write_text(json.dumps({"weight_map": {"layer.0": "model.safetensors", "x": "model-2.safetensors"}}))
    with pytest.raises(SourceError, match=r"names the shard model-2\.safetensors, which is missing"):
        read_shards(tmp_path, "*.safetensors")
    index.write_text(json.dumps({"weight_map": {"x": "model.safetensors"}}))
    with pytest.raises(SourceError, match=r"says that 'x' is in model\.safetensors, which does not hold it"):
        read_shards(tmp_path, "*.safetensors")
    index.write_text("{}")
    with pytest.raises(SourceError, match="is not an index of safetensors shards"):
        read_shards(tmp_path, "*.safetensors")
    index.unlink()
    before = fingerprint([shard])
    (tmp_path / "copy.safetensors").write_bytes(shard.read_bytes())
    with pytest.raises(SourceError, match=r"is in copy\.safetensors and in model\.safetensors"):
        read_shards(tmp_path, "*.safetensors")
    os.utime(shard, (1, 1))
    assert fingerprint([shard]) != before
