import contextlib
import io
import os
import random
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest

from vlatool.errors import BundleError, DataError
from vlatool.files.npz import open_npz

ARRAYS = {
    "image": np.arange(24, dtype=np.uint8).reshape(2, 3, 4),
    "state": np.asfortranarray(np.linspace(0, 1, 6).reshape(2, 3).astype(np.float32)),
    "text": np.array(["go to the red ball", "ü"]),
    "flag": np.array([True, False]),
    "empty": np.zeros((0, 3), np.int64),
    "single": np.array(3.5),
    "other_order": np.array([1.5, 2.5], ">f8"),
}


def packed(compress: bool = True, **arrays: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    (np.savez_compressed if compress else np.savez)(buffer, **(arrays or ARRAYS))
    return buffer.getvalue()


def archive_of(name: str, content: bytes, **entry: int) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(zipfile.ZipInfo(name), content, **entry)
    return buffer.getvalue()


def npy(header: str, content: bytes = b"") -> bytes:
    text = header.encode() + b"\n"
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(text)) + text + content


def bomb(declared: int) -> bytes:
    """Zeros that unpack to ``declared`` bytes and take a thousandth of them."""
    buffer = io.BytesIO()
    header = npy(f"{{'descr': '|u1', 'fortran_order': False, 'shape': ({declared},), }}")
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("a.npy", "w") as stream:
        stream.write(header)
        for _ in range(declared >> 20):
            stream.write(bytes(1 << 20))
    return buffer.getvalue()


@pytest.mark.parametrize("compress", [True, False])
def test_arrays_come_back_as_numpy_reads_them(tmp_path: Path, compress: bool):
    (tmp_path / "a.npz").write_bytes(packed(compress))
    for found in (open_npz(packed(compress)), open_npz(tmp_path / "a.npz"), open_npz(str(tmp_path / "a.npz"))):
        assert list(found) == list(ARRAYS)
        for name, array in ARRAYS.items():
            np.testing.assert_array_equal(found[name], array)
            assert found[name].dtype == array.dtype.newbyteorder("=")


def test_a_bomb_is_refused_before_it_is_unpacked(monkeypatch):
    monkeypatch.setenv("VLATOOL_LIMITS", "golden_bytes=1e6")
    with pytest.raises(
        BundleError, match=r"golden.npz, unpacked, has 2097\d+ bytes; the limit 'golden_bytes'"
    ) as caught:
        open_npz(bomb(2 << 20), "golden_bytes", where="golden.npz", error=BundleError)
    assert "VLATOOL_LIMITS=golden_bytes=2097" in caught.value.fix
    monkeypatch.setenv("VLATOOL_LIMITS", "golden_bytes=3e6")
    assert open_npz(bomb(2 << 20), "golden_bytes")["a"].nbytes == 2 << 20


def test_a_bomb_that_lies_about_its_size_unpacks_to_what_it_declared():
    content = bytearray(bomb(2 << 20))
    at = content.rfind(b"PK\1\2")
    struct.pack_into("<I", content, at + 24, 1000)
    with pytest.raises(DataError, match=r"cannot be read: Bad CRC-32|declares the shape"):
        open_npz(bytes(content))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not a zip archive"),
        (b"PK\5\6", "not a zip archive"),
        (packed()[:-30], "cannot be read"),
        (archive_of("a.txt", b"text"), "not an array"),
        (archive_of("a.npy", b"text"), r"not an array in the .npy format"),
        (archive_of("a.npy", npy("{'descr': '|O', 'fortran_order': False, 'shape': (1,), }")), "pickled objects"),
        (archive_of("a.npy", npy("{'descr': '<f4', 'fortran_order': False, 'shape': (9,), }", b"1")), "declares the"),
        (archive_of("a.npy", npy("{'descr': '<U0', 'fortran_order': False, 'shape': (99999999999,), }")), "neither n"),
        (archive_of("a.npy", npy("{'descr': '<M8', 'fortran_order': False, 'shape': (), }", bytes(8))), "neither n"),
        (archive_of("a.npy", npy("__import__('os')")), "not one of plain numbers"),
        (archive_of("a.npy", npy("{'descr': '|b1', 'fortran_order': False, 'shape': (1,), }", b"\7")), "truth values"),
        (archive_of("a.npy", npy("{'descr': '<U1', 'fortran_order': False, 'shape': (1,), }", b"\xff" * 4)), "Unicode"),
        (archive_of("a.npy", b"\x93NUMPY\2\0" + struct.pack("<I", 1 << 30)), "the header of an array has"),
        (archive_of("a.npy", b"", compress_type=zipfile.ZIP_BZIP2), "packed in a way"),
    ],
)  # fmt: skip
def test_what_is_no_archive_of_arrays_is_told(content, message):
    with pytest.raises(DataError, match=message):
        open_npz(content)


def test_a_single_array_is_told(tmp_path: Path):
    np.save(tmp_path / "a.npy", np.zeros(3))
    with pytest.raises(DataError, match="is one array, not an archive of named arrays"):
        open_npz(tmp_path / "a.npy")


def test_a_name_that_occurs_twice_is_refused():
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("a.npy", npy("{'descr': '|u1', 'fortran_order': False, 'shape': (), }", b"1"))
        with pytest.warns(UserWarning, match="Duplicate"):
            archive.writestr("a.npy", npy("{'descr': '|u1', 'fortran_order': False, 'shape': (), }", b"2"))
    with pytest.raises(DataError, match="twice"):
        open_npz(buffer.getvalue())


def test_a_table_of_contents_of_millions_of_names_is_refused():
    content = bytearray(packed())
    struct.pack_into("<I", content, len(content) - 10, 1 << 30)
    with pytest.raises(DataError, match="table of contents has 1073741824 bytes"):
        open_npz(bytes(content))


def test_many_arrays_are_refused(monkeypatch):
    monkeypatch.setenv("VLATOOL_LIMITS", "arrays=6")
    with pytest.raises(DataError, match="has 7 arrays; the limit 'arrays' allows 6"):
        open_npz(packed())


def test_a_missing_file_a_directory_and_a_pipe_are_told(tmp_path: Path):
    os.mkfifo(tmp_path / "pipe.npz")
    with pytest.raises(DataError, match=r"none.npz cannot be read: No such file"):
        open_npz(tmp_path / "none.npz")
    for name, message in (("", "Is a directory"), ("pipe.npz", "not a regular file")):
        with pytest.raises(DataError, match=message):
            open_npz(tmp_path / name)


def test_damaged_archives_give_their_error_or_arrays():
    """Flips, cuts and swaps: the typed error, or arrays, never anything else."""
    chance = random.Random(0)
    for original in (packed(True), packed(False)):
        for _ in range(400):
            content = bytearray(original)
            for _ in range(chance.choice((1, 1, 3))):
                content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
            if chance.random() < 0.2:
                del content[chance.randrange(len(content)) :]
            with contextlib.suppress(DataError):
                assert set(open_npz(bytes(content)))
