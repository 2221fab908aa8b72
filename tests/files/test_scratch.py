"""Places that a person never sees: no message names them, they are gone in the end, and are blamed when full."""

from __future__ import annotations

import errno
import fcntl
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from vlatool.errors import BundleError, GraphError, OutputError, VlatoolError
from vlatool.files import scratch as scratch_module
from vlatool.files.directory_writer import write_directory
from vlatool.files.npz import open_rows
from vlatool.files.scratch import scratch_directory
from vlatool.files.user_files import atomic_file
from vlatool.measurement.child import end_error
from vlatool.measurement.jobs import Limits
from vlatool.runtime.engines.openvino import OpenvinoSession
from vlatool.runtime.engines.ort_cpu import OrtCpuSession
from vlatool.user_code.children import call


def refused_by_onnxruntime(place: Path) -> None:
    (place / "graphs").mkdir()
    (place / "graphs/main.onnx").write_bytes(b"no graph")
    OrtCpuSession(place / "graphs/main.onnx")


def refused_by_openvino(place: Path) -> None:
    (place / "graphs").mkdir()
    (place / "graphs/main.onnx").write_bytes(b"no graph")
    OpenvinoSession(place / "graphs/main.onnx")


def corrupt(place: Path) -> None:
    (place / "graphs").mkdir()
    (place / "graphs/main.onnx").write_bytes(b"PK not an archive")
    open_rows(place / "graphs/main.onnx")


def last_words(place: Path) -> None:
    code = "import sys; sys.exit(f'cannot map {sys.argv[1]}/graphs/main.onnx')"
    done = subprocess.run([sys.executable, "-c", code, str(place)], capture_output=True, text=True, check=False)
    raise end_error("the policy", done.returncode, done.stderr, Limits())


def a_child(place: Path) -> None:
    file = str(place / "graphs/main.onnx")
    call("vlatool.stage._child:run", {"stage": "sources.onnx", "options": {"model": file}, "source": ""}, print, file)


def named_in_the_fix(place: Path) -> None:
    raise BundleError("It is wrong.", f"remove {place}/graphs/main.onnx")


KINDS = (refused_by_onnxruntime, refused_by_openvino, corrupt, last_words, a_child, named_in_the_fix)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
@pytest.mark.parametrize("out", ["out", "deep/run[1]"])
def test_an_error_about_a_draft_names_the_output(tmp_path: Path, monkeypatch, kind: Callable[[Path], None], out: str):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(VlatoolError) as caught, write_directory(Path(out)) as draft:
        kind(draft)
    told = str(caught.value)
    assert f"{out}/graphs/main.onnx" in told
    assert ".tmp-" not in told
    assert "/content" not in told


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_an_error_about_a_draft_in_the_cache_names_the_file_alone(tmp_path: Path, kind: Callable[[Path], None]):
    with (
        pytest.raises(VlatoolError) as caught,
        write_directory(tmp_path / "stages/export.onnx-0a1b", damaged=True) as draft,
    ):
        kind(draft)
    told = str(caught.value)
    assert "graphs/main.onnx" in told
    assert str(tmp_path) not in told


def test_an_error_about_a_draft_in_the_cache_as_a_whole_names_its_stage(tmp_path: Path):
    place = tmp_path / "stages/export.onnx-0a1b"
    with pytest.raises(BundleError) as caught, write_directory(place, damaged=True) as draft:
        raise BundleError(f"{draft} is half.")
    assert caught.value.message == "the output of export.onnx is half."


def test_a_link_on_the_way_to_a_draft_hides_it_from_nobody(tmp_path: Path):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    with pytest.raises(GraphError) as caught, write_directory(tmp_path / "link/out") as draft:
        raise GraphError(f"the library refuses {os.path.realpath(draft)}/main.onnx")
    assert caught.value.message == f"the library refuses {tmp_path}/link/out/main.onnx"


def test_an_error_of_the_system_names_the_output(tmp_path: Path):
    with pytest.raises(FileNotFoundError) as caught, write_directory(tmp_path / "out") as draft:
        (draft / "graphs/main.onnx").read_bytes()
    assert caught.value.filename == str(tmp_path / "out/graphs/main.onnx")


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_of_the_cache_says_where_the_cache_could_be(tmp_path: Path, number: int):
    with pytest.raises(OutputError) as caught, write_directory(tmp_path / "stages/x-1", damaged=True) as draft:
        raise OSError(number, os.strerror(number), str(draft / "a"))
    assert "VLATOOL_CACHE=DIR" in caught.value.fix
    assert "vlatool cache prune" in caught.value.fix
    assert "to the cache" in caught.value.message
    assert ".tmp-" not in caught.value.message


@pytest.mark.parametrize("number", [errno.EROFS, errno.EACCES])
def test_a_cache_that_may_not_be_written_says_where_it_could_be(tmp_path: Path, monkeypatch, number: int):
    def refuse(path: Path, *_args, **_options):
        raise OSError(number, os.strerror(number), str(path))

    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(OutputError) as caught, write_directory(tmp_path / "stages/x-1", damaged=True):
        pytest.fail("the block must not run")
    assert caught.value.fix == "keep the cache elsewhere: VLATOOL_CACHE=DIR"


def test_a_cache_below_a_file_says_where_it_could_be(tmp_path: Path):
    (tmp_path / "file").touch()
    with pytest.raises(OutputError) as caught, write_directory(tmp_path / "file/stages/x-1", damaged=True):
        pytest.fail("the block must not run")
    assert "VLATOOL_CACHE=DIR" in caught.value.fix


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_an_error_about_a_scratch_folder_names_the_file_alone(kind: Callable[[Path], None]):
    with pytest.raises(VlatoolError) as caught, scratch_directory() as place:
        kind(place)
    told = str(caught.value)
    assert "graphs/main.onnx" in told
    assert str(place) not in told
    assert not place.exists()


def test_an_error_about_the_draft_of_a_file_names_the_file(tmp_path: Path):
    with pytest.raises(OutputError) as caught, atomic_file(tmp_path / "v.mp4") as draft:
        raise OutputError(f"ffmpeg could not write the video: {draft}: it is full.", "write a .gif")
    assert caught.value.message == f"ffmpeg could not write the video: {tmp_path}/v.mp4: it is full."
    with pytest.raises(OSError, match="full") as met, atomic_file(tmp_path / "v.mp4") as draft:
        raise OSError(errno.ENOSPC, "full", str(draft))
    assert met.value.filename == str(tmp_path / "v.mp4")
    assert [path.name for path in tmp_path.iterdir()] == ["temporary"]


KILLED = """
import os
from vlatool.files.scratch import scratch_directory
with scratch_directory() as folder:
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
        with scratch_directory() as folder:
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
    with scratch_directory() as folder:
        assert list(temporary.iterdir()) == [folder]


OTHERS = ("vlatool-{own}-12345678", "vlatool-12345678", "vlatool-x-12345678", "vlatool-{gone}-1234567",
          "vlatool-{gone}-12345678.bak")  # fmt: skip


@pytest.mark.parametrize("name", OTHERS)
def test_what_is_in_use_or_somebody_elses_stays(temporary: Path, name: str) -> None:
    place = temporary / name.format(own=os.getpid(), gone=GONE)
    place.mkdir()
    with scratch_directory():
        assert place.is_dir()


def test_a_link_is_not_followed_and_a_held_lock_counts(temporary: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/file").write_text("mine")
    (temporary / f"vlatool-{GONE}-12345678").symlink_to(tmp_path / "mine")
    (temporary / f"vlatool-{GONE}-87654321").mkdir()
    handle = os.open(temporary / f"vlatool-{GONE}-87654321", os.O_RDONLY)
    fcntl.flock(handle, fcntl.LOCK_EX)
    with scratch_directory():
        pass
    os.close(handle)
    assert (tmp_path / "mine/file").read_text() == "mine"
    assert (temporary / f"vlatool-{GONE}-87654321").is_dir(), "a process of another container has it"


def test_a_full_temporary_folder_is_blamed_and_not_the_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scratch_module.shutil, "disk_usage", lambda _: SimpleNamespace(free=4096))
    says = f"Cannot write temporary files to {tmp_path}/temporary: the disk is full"
    with pytest.raises(OutputError, match=says) as caught, write_directory(tmp_path / "out"), scratch_directory():
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert "TMPDIR" in caught.value.fix
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("named", [True, False])
def test_a_disk_that_is_full_elsewhere_is_not_the_temporary_folders(tmp_path: Path, named: bool) -> None:
    where = (str(tmp_path / "out/file"),) if named else ()
    with pytest.raises(OutputError, match=f"Cannot write {tmp_path}/out: the disk is full"), \
            write_directory(tmp_path / "out"), scratch_directory():  # fmt: skip
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), *where)


def test_a_directory_that_is_written_among_temporary_files_is_one_of_them() -> None:
    with scratch_directory() as folder, pytest.raises(OutputError, match="Cannot write temporary files: ") as caught, \
            write_directory(folder / "0-export.onnx"):  # fmt: skip
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert "TMPDIR" in caught.value.fix
