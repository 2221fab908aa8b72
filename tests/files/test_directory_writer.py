import errno
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from vlatool.errors import OutputError
from vlatool.files.atomic_rename import exchange, rename_to_new
from vlatool.files.directory_writer import _is_alive, write_directory
from vlatool.files.ownership import LEDGER

WRITER = """
import sys
from pathlib import Path
from vlatool.files.directory_writer import write_directory
with write_directory(Path(sys.argv[1]), force=True) as draft:
    (draft / "graphs").mkdir()
    (draft / "graphs/main.onnx").write_bytes(b"half of the weights")
    print(draft, flush=True)
    sys.stdin.readline()
"""


KILLED = """
import os, sys
from pathlib import Path
from vlatool.files.directory_writer import write_directory
with write_directory(Path(sys.argv[1])) as draft:
    (draft / "half").touch()
    print(draft.parent, flush=True)
    os.kill(os.getpid(), 9)
"""
KILLED_LATE = """
import os, sys
from pathlib import Path
from vlatool.files import directory_writer as module
def kill(*_args, **_options):
    os.kill(os.getpid(), 9)
replace = module._replace
def last_rename_is_missing(*arguments):
    module.rename_to_new = kill
    replace(*arguments)
if sys.argv[2] != "exchange":
    module.exchange = lambda one, other: False
if sys.argv[3] == "between":
    module._replace = last_rename_is_missing
else:
    module.remove_owned = kill
with module.write_directory(Path(sys.argv[1]), force=True) as draft:
    (draft / "new").touch()
"""


def fill(directory: Path) -> Path:
    (directory / "graphs").mkdir(parents=True)
    (directory / "graphs/main.onnx").write_bytes(b"weights" * 100)
    (directory / "assets").mkdir()
    (directory / "assets/words.json").write_text("{}")
    return directory


def stop_half_way(draft: Path) -> None:
    fill(draft)
    raise RuntimeError("half-way")


def content(directory: Path) -> dict[str, bytes]:
    files = {path.name: path for path in directory.rglob("*") if path.is_file()}
    return {name: path.read_bytes() for name, path in files.items() if name != LEDGER}


def written(directory: Path) -> Path:
    """A directory that vlatool wrote."""
    with write_directory(directory) as draft:
        fill(draft)
    return directory


def written_meanwhile(first: Path, final: Path) -> None:
    fill(first)
    with write_directory(final) as second:
        (second / "second").touch()
        assert first.is_dir()


def abandoned(final: Path) -> Path:
    """The draft of a writer that was killed."""
    done = subprocess.run([sys.executable, "-c", KILLED, str(final)], stdout=subprocess.PIPE, text=True, check=False)
    assert done.returncode == -signal.SIGKILL
    return Path(done.stdout.strip())


@pytest.fixture
def writer(tmp_path: Path) -> Iterator[tuple[subprocess.Popen[str], Path]]:
    """A process that is in the middle of writing ``tmp_path/out``, and its draft."""
    command = [sys.executable, "-c", WRITER, str(tmp_path / "out")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        yield process, Path(process.stdout.readline().strip())
        process.kill()


def test_the_directory_appears_when_the_block_ends_well(tmp_path: Path):
    final = tmp_path / "deep/down/out"
    with write_directory(final) as draft:
        assert not final.exists()
        fill(draft)
    assert content(final) == content(fill(tmp_path / "wanted"))
    assert os.listdir(final.parent) == ["out"]


def test_nothing_is_left_when_the_block_raises(tmp_path: Path):
    with pytest.raises(RuntimeError, match="half-way"), write_directory(tmp_path / "out") as draft:
        stop_half_way(draft)
    assert os.listdir(tmp_path) == []


def test_the_old_content_stays_when_the_block_raises(tmp_path: Path):
    before = content(written(tmp_path / "out"))
    with pytest.raises(RuntimeError, match="half-way"), write_directory(tmp_path / "out", force=True) as draft:
        stop_half_way(draft)
    assert content(tmp_path / "out") == before
    assert os.listdir(tmp_path) == ["out"]


def test_an_existing_output_is_refused(tmp_path: Path):
    before = content(fill(tmp_path / "out"))
    with pytest.raises(OutputError, match="exists already") as caught, write_directory(tmp_path / "out"):
        pytest.fail("the block must not run")
    assert "--force" in caught.value.fix
    assert content(tmp_path / "out") == before


def test_force_replaces_all_of_the_old_content(tmp_path: Path):
    written(tmp_path / "out")
    with write_directory(tmp_path / "out", force=True) as draft:
        (draft / "new").write_bytes(b"1")
    assert content(tmp_path / "out") == {"new": b"1"}
    assert os.listdir(tmp_path) == ["out"]


def test_force_replaces_no_file(tmp_path: Path):
    (tmp_path / "out").write_text("a file")
    with pytest.raises(OutputError, match="is not a directory"), write_directory(tmp_path / "out", force=True):
        pytest.fail("the block must not run")
    assert (tmp_path / "out").read_text() == "a file"


def test_a_relative_output_does_not_follow_a_change_of_directory(tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with write_directory(Path("out")) as draft:
        (tmp_path / "elsewhere").mkdir()
        os.chdir(tmp_path / "elsewhere")
        (draft / "new").touch()
    assert (tmp_path / "out/new").is_file()


@pytest.mark.parametrize("name", ["out", "run[1]", "*"])
def test_the_draft_of_a_dead_process_is_swept(tmp_path: Path, name: str):
    assert abandoned(tmp_path / name).is_dir()
    with write_directory(tmp_path / name) as draft:
        (draft / "new").touch()
    assert os.listdir(tmp_path) == [name]


def test_a_draft_that_was_only_begun_is_swept(tmp_path: Path):
    begun = tmp_path / ".out.tmp-999999999-0badcafe"
    (begun / "content").mkdir(parents=True)
    (begun / "vlatool-draft.json").touch()
    with write_directory(tmp_path / "out") as draft:
        (draft / "new").touch()
    assert os.listdir(tmp_path) == ["out"]


@pytest.mark.parametrize("name", [".out.tmp-123-abc", ".out.tmp-999999999-0badcafe", ".out.old-0badcafe"])
def test_a_directory_that_is_only_called_like_a_draft_is_left_alone(tmp_path: Path, name: str):
    before = content(fill(tmp_path / name))
    with write_directory(tmp_path / "out") as draft:
        (draft / "new").touch()
    assert content(tmp_path / name) == before


def test_a_copy_of_a_draft_is_left_alone(tmp_path: Path):
    draft = abandoned(tmp_path / "out")
    copy = tmp_path / ".out.tmp-999999999-0badcafe"
    shutil.copytree(draft, copy)
    with write_directory(tmp_path / "out") as own:
        (own / "new").touch()
    assert not draft.exists()
    assert (copy / "content/half").is_file()


def test_the_draft_of_another_output_is_left_alone(tmp_path: Path):
    fill(tmp_path / ".other.tmp-999999999-0badcafe")
    with write_directory(tmp_path / "out") as draft:
        (draft / "new").touch()
    assert sorted(os.listdir(tmp_path)) == [".other.tmp-999999999-0badcafe", "out"]


def test_a_draft_that_another_sweep_takes_away_is_not_alive(tmp_path: Path):
    assert not _is_alive(tmp_path / ".out.tmp-999999999-0badcafe")


def test_the_draft_of_a_living_process_is_left_alone(tmp_path: Path, writer):
    process, draft = writer
    written(tmp_path / "out")
    assert (draft / "graphs/main.onnx").read_bytes() == b"half of the weights"
    process.communicate("go on\n")
    assert process.returncode == 0
    assert content(tmp_path / "out") == {"main.onnx": b"half of the weights"}


def test_of_two_writers_without_force_exactly_one_ends_well(tmp_path: Path):
    with pytest.raises(OutputError, match="exists already"), write_directory(tmp_path / "out") as first:
        written_meanwhile(first, tmp_path / "out")
    assert content(tmp_path / "out") == {"second": b""}
    assert os.listdir(tmp_path) == ["out"]


def test_of_many_writers_at_once_exactly_one_ends_well(tmp_path: Path):
    together = threading.Barrier(8)

    def write(number: int) -> str:
        try:
            with write_directory(tmp_path / "out") as draft:
                (draft / str(number)).touch()
                together.wait(60)
        except OutputError as error:
            return error.message
        return ""

    with ThreadPoolExecutor(8) as pool:
        told = list(pool.map(write, range(8)))
    assert told.count("") == 1
    assert content(tmp_path / "out") == {str(told.index("")): b""}
    assert os.listdir(tmp_path) == ["out"]


def test_a_killed_writer_leaves_nothing_at_the_output_and_the_next_run_succeeds(tmp_path: Path, writer):
    process, draft = writer
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert draft.is_dir()
    assert not (tmp_path / "out").exists()
    with write_directory(tmp_path / "out") as own:
        (own / "new").touch()
    assert content(tmp_path / "out") == {"new": b""}
    assert os.listdir(tmp_path) == ["out"]


def test_a_killed_writer_leaves_the_old_content(tmp_path: Path, writer):
    process, _ = writer
    before = content(fill(tmp_path / "out"))
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert content(tmp_path / "out") == before


@pytest.mark.parametrize("how", ["exchange", "two renames"])
def test_what_was_replaced_goes_with_the_next_run_when_the_writer_was_killed(tmp_path: Path, how: str):
    written(tmp_path / "out")
    done = subprocess.run([sys.executable, "-c", KILLED_LATE, str(tmp_path / "out"), how, "after"], check=False)
    assert done.returncode == -signal.SIGKILL
    assert content(tmp_path / "out") == {"new": b""}
    assert len(os.listdir(tmp_path)) == 2
    with write_directory(tmp_path / "out", force=True) as draft:
        (draft / "newer").touch()
    assert content(tmp_path / "out") == {"newer": b""}
    assert os.listdir(tmp_path) == ["out"]


def test_a_writer_killed_between_two_renames_has_lost_nothing(tmp_path: Path):
    before = content(written(tmp_path / "out"))
    done = subprocess.run([sys.executable, "-c", KILLED_LATE, str(tmp_path / "out"), "renames", "between"], check=False)
    assert done.returncode == -signal.SIGKILL
    assert not (tmp_path / "out").exists()
    with pytest.raises(OutputError, match="exists already"), write_directory(tmp_path / "out"):
        pass
    assert content(tmp_path / "out") == before
    assert os.listdir(tmp_path) == ["out"]


def test_a_file_that_came_while_it_was_written_is_never_replaced(tmp_path: Path):
    written(tmp_path / "out")
    message = "out/notes.txt was not written by vlatool"
    with pytest.raises(OutputError, match=message), write_directory(tmp_path / "out", force=True) as draft:
        assert (draft / "new").write_text("new") < (tmp_path / "out/notes.txt").write_text("mine")
    assert (tmp_path / "out/notes.txt").read_text() == "mine"
    assert (tmp_path / "out/graphs/main.onnx").is_file()
    assert os.listdir(tmp_path) == ["out"]


def test_what_came_at_the_last_moment_is_kept_beside_it(tmp_path: Path, monkeypatch):
    written(tmp_path / "out")

    def late(one: Path, other: Path) -> bool:
        (other / "notes.txt").write_text("mine")
        return exchange(one, other)

    monkeypatch.setattr("vlatool.files.directory_writer.exchange", late)
    with (
        pytest.warns(UserWarning, match="was not written by vlatool"),
        write_directory(tmp_path / "out", force=True) as draft,
    ):
        (draft / "new").touch()
    (kept,) = tmp_path.glob("out.kept-*")
    assert (kept / "notes.txt").read_text() == "mine"
    assert content(tmp_path / "out") == {"new": b""}


def test_without_an_exchange_the_old_one_comes_back_when_the_new_one_cannot(tmp_path: Path, monkeypatch):
    before = content(written(tmp_path / "out"))
    moves = []

    def fail_once(source: Path, target: Path) -> None:
        moves.append(target)
        if len(moves) == 2:  # the first finds that there is something
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        rename_to_new(source, target)

    monkeypatch.setattr("vlatool.files.directory_writer.exchange", lambda one, other: False)
    monkeypatch.setattr("vlatool.files.directory_writer.rename_to_new", fail_once)
    with pytest.raises(OutputError, match="disk is full"), write_directory(tmp_path / "out", force=True) as draft:
        (draft / "new").touch()
    assert content(tmp_path / "out") == before
    assert os.listdir(tmp_path) == ["out"]


def test_a_damaged_directory_of_the_cache_is_replaced_and_what_is_not_ours_is_kept(tmp_path: Path):
    out = written(tmp_path / "out")
    (out / "graphs/main.onnx").write_bytes(b"damaged")
    (out / "notes.txt").write_text("mine")
    with pytest.warns(UserWarning, match="was not written by vlatool"), write_directory(out, damaged=True) as draft:
        (draft / "new").touch()
    (kept,) = tmp_path.glob("out.kept-*")
    assert content(kept) == {"notes.txt": b"mine"}
    assert content(out) == {"new": b""}


@pytest.mark.parametrize(
    ("number", "message"),
    [(errno.ENOSPC, "the disk is full"), (errno.EDQUOT, "the disk quota is used up")],
)
def test_a_full_disk_is_told_and_leaves_nothing(tmp_path: Path, number, message):
    with pytest.raises(OutputError, match=f"Cannot write {tmp_path}/out: {message}"), write_directory(tmp_path / "out"):
        raise OSError(number, os.strerror(number))
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(("number", "message"), [
    (errno.ENOSPC, "the disk is full"), (errno.EROFS, "the file system is read-only"),
    (errno.ENOTDIR, "a part of the path is a file"), (errno.ENOENT, "nothing can be made there"),
])  # fmt: skip
def test_where_the_cache_cannot_be_written_another_cache_helps_and_no_other_output(
    tmp_path: Path, monkeypatch, number, message
):
    def refuse(path: Path, *_args, **_options):
        raise OSError(number, os.strerror(number), str(path))

    monkeypatch.setattr(Path, "mkdir", refuse)
    with (
        pytest.raises(OutputError, match=f"Cannot write to the cache: .*{message}") as caught,
        write_directory(tmp_path / "stages/x", damaged=True),
    ):
        pytest.fail("the block must not run")
    assert "VLATOOL_CACHE" in caught.value.fix


def test_a_file_elsewhere_that_a_disk_has_no_room_for_is_named(tmp_path: Path):
    with pytest.raises(OSError, match="elsewhere/file"), write_directory(tmp_path / "out"):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(tmp_path / "elsewhere/file"))


def test_a_copy_that_has_no_room_is_the_fault_of_where_it_goes(tmp_path: Path):
    """The operating system names the source of a copy first."""
    with pytest.raises(OutputError, match=f"Cannot write {tmp_path}/out: the disk is full"), \
            write_directory(tmp_path / "out") as draft:  # fmt: skip
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(tmp_path / "source"), None, str(draft / "file"))


def test_a_disk_that_is_full_from_the_first_byte_leaves_nothing(tmp_path: Path, monkeypatch):
    def full(path: Path, *_args: object, **_options: object) -> None:
        path.touch()
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(OutputError, match="the disk is full"), write_directory(tmp_path / "out"):
        pytest.fail("the block must not run")
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    ("number", "message"),
    [
        (errno.EROFS, "the file system is read-only"),
        (errno.EACCES, "permission denied"),
        (errno.ENOENT, "nothing can be made there"),
    ],
)
def test_a_place_that_may_not_be_written_to(tmp_path: Path, monkeypatch, number, message):
    def refuse(path: Path, *_args, **_options):
        raise OSError(number, os.strerror(number), str(path))

    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(OutputError, match=message) as caught, write_directory(tmp_path / "out"):
        pytest.fail("the block must not run")
    assert caught.value.fix


@pytest.mark.parametrize("place", ["file/out", "file/deep/out"])
def test_a_path_under_a_file(tmp_path: Path, place: str):
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="a part of the path is a file"), write_directory(tmp_path / place):
        pytest.fail("the block must not run")


def test_an_error_of_the_block_that_is_not_about_the_output_stays_itself(tmp_path: Path):
    with pytest.raises(FileNotFoundError), write_directory(tmp_path / "out"):
        (tmp_path / "absent").read_text()
    with pytest.raises(PermissionError), write_directory(tmp_path / "out"):
        raise PermissionError(errno.EACCES, "Permission denied", "/somewhere/else")


def test_an_input_beside_the_output_that_may_not_be_read_is_not_blamed_on_the_output(tmp_path: Path):
    source = str(tmp_path / "policy/weights.safetensors")
    with pytest.raises(PermissionError), write_directory(tmp_path / "out"):
        raise PermissionError(errno.EACCES, "Permission denied", source)
