"""Folders for temporary files: gone in the end, whatever happened, and blamed for a full disk where theirs is full."""

from __future__ import annotations

import errno
import fcntl
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace

import pytest

from vlatool.errors import OutputError
from vlatool.files import scratch as scratch_module
from vlatool.files.scratch import scratch
from vlatool.files.writing import writing

KILLED = """
import os
from vlatool.files.scratch import scratch
with scratch() as folder:
    (folder / "weights").write_bytes(b"large")
    print(folder, flush=True)
    os.kill(os.getpid(), 9)
"""
GONE = 2**22 + 1
"""No process has this number."""


@pytest.fixture(autouse=True)
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder for temporary files."""
    place = tmp_path / "temporary"
    place.mkdir()
    monkeypatch.setenv("TMPDIR", str(place))
    monkeypatch.setattr(tempfile, "tempdir", None)
    return place


@pytest.mark.parametrize("error", [None, ValueError, KeyboardInterrupt])
def test_it_is_removed_with_what_is_in_it(temporary: Path, error: type[BaseException] | None) -> None:
    def used() -> None:
        with scratch() as folder:
            assert folder.parent == temporary
            (folder / "deep/down").mkdir(parents=True)
            (folder / "deep/file").write_text("some")
            if error is not None:
                raise error

    if error is None:
        used()
    else:
        with pytest.raises(error):
            used()
    assert list(temporary.iterdir()) == []


def test_what_a_killed_process_left_is_removed_by_the_next(temporary: Path) -> None:
    told = subprocess.run([sys.executable, "-c", KILLED], capture_output=True, text=True, check=False)
    left = Path(told.stdout.strip())
    assert (left / "weights").exists()
    with scratch() as folder:
        assert list(temporary.iterdir()) == [folder]


@pytest.mark.parametrize("name", [f"vlatool-{os.getpid()}-12345678", "vlatool-12345678", "vlatool-x-12345678",
                                  f"vlatool-{GONE}-1234567", f"vlatool-{GONE}-12345678.bak"])  # fmt: skip
def test_what_is_in_use_or_somebody_elses_stays(temporary: Path, name: str) -> None:
    (temporary / name).mkdir()
    with scratch():
        assert (temporary / name).is_dir()


def test_a_link_is_not_followed_and_a_held_lock_counts(temporary: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/file").write_text("mine")
    (temporary / f"vlatool-{GONE}-12345678").symlink_to(tmp_path / "mine")
    (temporary / f"vlatool-{GONE}-87654321").mkdir()
    handle = os.open(temporary / f"vlatool-{GONE}-87654321", os.O_RDONLY)
    fcntl.flock(handle, fcntl.LOCK_EX)
    with scratch():
        pass
    os.close(handle)
    assert (tmp_path / "mine/file").read_text() == "mine"
    assert (temporary / f"vlatool-{GONE}-87654321").is_dir(), "a process of another container has it"


def test_a_full_temporary_folder_is_blamed_and_not_the_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scratch_module.shutil, "disk_usage", lambda _: SimpleNamespace(free=4096))
    says = f"Cannot write temporary files to {tmp_path}/temporary: the disk is full"
    with pytest.raises(OutputError, match=says) as caught, writing(tmp_path / "out"), scratch():
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert "TMPDIR" in caught.value.fix
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("named", [True, False])
def test_a_disk_that_is_full_elsewhere_is_not_the_temporary_folders(tmp_path: Path, named: bool) -> None:
    where = (str(tmp_path / "out/file"),) if named else ()
    with pytest.raises(OutputError, match=f"Cannot write {tmp_path}/out: the disk is full"), \
            writing(tmp_path / "out"), scratch():  # fmt: skip
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), *where)


def test_a_directory_that_is_written_among_temporary_files_is_one_of_them() -> None:
    with scratch() as folder, pytest.raises(OutputError, match="Cannot write temporary files: ") as caught, \
            writing(folder / "0-export.onnx"):  # fmt: skip
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert "TMPDIR" in caught.value.fix
