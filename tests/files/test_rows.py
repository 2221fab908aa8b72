import os
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vlatool.errors import DataError
from vlatool.files.npz import open_rows
from vlatool.files.rows import Rows, blocks

COUNT = 50


def frames(count: int = COUNT) -> Any:
    return np.random.default_rng(0).integers(0, 256, (count, 8, 8, 3), np.uint8)


@pytest.fixture(params=[np.savez, np.savez_compressed], ids=["stored", "packed"])
def save(request: pytest.FixtureRequest) -> Callable[..., None]:
    save: Callable[..., None] = request.param
    return save


def rows(path: Path, name: str = "image") -> Rows:
    found = open_rows(path, in_memory=64)[name]
    assert isinstance(found, Rows)
    return found


@pytest.mark.parametrize(
    "values",
    [frames(), frames().astype(">f4"), frames() > 127, frames().astype(np.int64), frames()[:, :0]],
    ids=["uint8", "big-endian", "bool", "int64", "no elements"],
)
def test_rows_are_those_of_the_array_in_any_order(tmp_path: Path, save: Callable[..., None], values: Any):
    save(tmp_path / "a.npz", other=np.arange(100.0), image=values)
    found = open_rows(tmp_path / "a.npz", in_memory=64)["image"]
    for at in (0, 49, 3, 4, 48, 0, -1, 7):
        np.testing.assert_array_equal(found[at], values[at])
    np.testing.assert_array_equal(found[[5, 2, 5]], values[[5, 2, 5]])
    assert (found.shape, found.dtype, len(found)) == (values.shape, values.dtype.newbyteorder("="), COUNT)


def test_blocks_are_all_rows_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, save: Callable[..., None]):
    monkeypatch.setattr("vlatool.files.rows.BLOCK_BYTES", 700)
    save(tmp_path / "a.npz", image=frames())
    found = list(blocks(rows(tmp_path / "a.npz")))
    assert [first for first, _ in found][:3] == [0, 3, 6]
    np.testing.assert_array_equal(np.concatenate([block for _, block in found]), frames())


def test_small_arrays_text_and_fortran_order_are_in_memory(tmp_path: Path):
    text = np.array(["one", "two"] * 50)
    np.savez(tmp_path / "a.npz", small=np.arange(3), text=text, fortran=np.asfortranarray(frames()), one=np.float32(1))
    found = open_rows(tmp_path / "a.npz", in_memory=200)
    assert {type(values) for values in found.values()} == {np.ndarray}
    np.testing.assert_array_equal(found["fortran"], frames())


def test_rows_beyond_the_end_are_refused(tmp_path: Path, save: Callable[..., None]):
    save(tmp_path / "a.npz", image=frames())
    for at in (COUNT, -COUNT - 1):
        with pytest.raises(IndexError):
            rows(tmp_path / "a.npz")[at]


def test_a_flipped_bit_is_found_before_any_row_is_read(tmp_path: Path, save: Callable[..., None]):
    path = tmp_path / "a.npz"
    save(path, image=frames())
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(DataError, match="cannot be read"):
        open_rows(path, in_memory=64)


def test_truth_values_that_are_none_are_refused(tmp_path: Path):
    np.savez(tmp_path / "a.npz", image=np.zeros(1000, np.bool_))
    with zipfile.ZipFile(tmp_path / "a.npz") as archive:
        content = bytearray(archive.read("image.npy"))
    content[-5] = 7
    with zipfile.ZipFile(tmp_path / "b.npz", "w") as archive:
        archive.writestr("image.npy", bytes(content))
    with pytest.raises(DataError, match="neither 0 nor 1"):
        open_rows(tmp_path / "b.npz", in_memory=64)


def test_a_file_that_is_cut_while_it_is_read_is_told(tmp_path: Path):
    np.savez(tmp_path / "a.npz", image=frames())
    found = rows(tmp_path / "a.npz")
    os.truncate(tmp_path / "a.npz", 300)
    with pytest.raises(DataError, match=r"'image' in .*a\.npz was changed while it was read"):
        found[COUNT - 1]


def test_a_file_whose_name_is_given_to_another_is_still_the_first(tmp_path: Path, save: Callable[..., None]):
    save(tmp_path / "a.npz", image=frames())
    found = rows(tmp_path / "a.npz")
    save(tmp_path / "b.npz", image=frames()[::-1])
    os.replace(tmp_path / "b.npz", tmp_path / "a.npz")
    np.testing.assert_array_equal(found[3], frames()[3])


def test_a_full_disk_is_told_when_a_packed_array_must_be_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    np.savez_compressed(tmp_path / "a.npz", image=frames())
    found = rows(tmp_path / "a.npz")

    def full(_handle: int, _block: bytes) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("vlatool.files.rows.os.write", full)
    found[5], found[1]
    with pytest.raises(DataError, match="No space left on device") as caught:
        found[0]
    assert "np.savez instead" in caught.value.fix


def test_a_disk_that_takes_a_part_of_a_block_gets_the_rest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    np.savez_compressed(tmp_path / "a.npz", image=frames())
    found, write = rows(tmp_path / "a.npz"), os.write
    monkeypatch.setattr("vlatool.files.rows.os.write", lambda handle, block: write(handle, block[:1000]))
    for at in (9, 7, 5, 3, 1):
        np.testing.assert_array_equal(found[at], frames()[at])


def test_a_packed_array_that_is_read_out_of_order_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "scratch"))
    (tmp_path / "scratch").mkdir()
    np.savez_compressed(tmp_path / "a.npz", image=frames())
    found = rows(tmp_path / "a.npz")
    for at in (9, 7, 5, 3, 1):
        np.testing.assert_array_equal(found[at], frames()[at])
    assert list((tmp_path / "scratch").iterdir()) == []


READ = """
import resource, sys
from pathlib import Path
from vlatool.data import read_recording
from vlatool.bundle.spec import PolicySpec, TensorSpec
spec = PolicySpec((TensorSpec("image", (1, 128, 128, 3)),), (TensorSpec("move", (1, 1, 2)),), 10.0, 1)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
recording = read_recording(Path(sys.argv[1]), spec)
total = sum(float(each["image"].mean()) for each in recording)
print(len(recording), total, (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024)
"""


def test_a_recording_takes_the_memory_of_a_few_frames(tmp_path: Path, save: Callable[..., None]):
    frame = np.ones((128, 128, 3), np.float32)
    np.savez(tmp_path / "one.npz", image=frame[None])
    save(tmp_path / "a.npz", image=np.broadcast_to(frame, (1000, *frame.shape)))
    assert (tmp_path / "a.npz").stat().st_size < 2**30
    done = subprocess.run([sys.executable, "-c", READ, tmp_path / "a.npz"], capture_output=True, text=True, check=True)
    count, total, grown = done.stdout.split()
    assert (count, float(total)) == ("1000", 1000.0)
    assert int(grown) < 60  # MB, of 197 MB of frames


def test_streams_do_not_share_a_position(tmp_path: Path):
    np.savez_compressed(tmp_path / "a.npz", one=frames(), two=frames()[::-1])
    found = open_rows(tmp_path / "a.npz", in_memory=64)
    for at in range(COUNT):
        np.testing.assert_array_equal(found["one"][at], frames()[at])
        np.testing.assert_array_equal(found["two"][at], frames()[COUNT - 1 - at])


def test_chosen_rows_stay_on_the_disk(tmp_path: Path, save: Callable[..., None]):
    save(tmp_path / "a.npz", image=frames())
    chosen = np.arange(COUNT) % 3 == 1
    found = rows(tmp_path / "a.npz").select(chosen)
    assert isinstance(found, Rows)
    np.testing.assert_array_equal(found.read(0, len(found)), frames()[chosen])
    np.testing.assert_array_equal(found[[15, 2]], frames()[chosen][[15, 2]])
    np.testing.assert_array_equal(found.select(np.arange(len(found)) > 3)[0], frames()[chosen][4])
