import errno
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from vlatool.errors import OutputError
from vlatool.writing import _is_alive, writing

WRITER = """
import sys
from pathlib import Path
from vlatool.writing import writing
with writing(Path(sys.argv[1]), force=True) as draft:
    (draft / "graphs").mkdir()
    (draft / "graphs/main.onnx").write_bytes(b"half of the weights")
    print(draft, flush=True)
    sys.stdin.readline()
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
    return {path.name: path.read_bytes() for path in directory.rglob("*") if path.is_file()}


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
    with writing(final) as draft:
        assert not final.exists()
        fill(draft)
    assert content(final) == content(fill(tmp_path / "wanted"))
    assert os.listdir(final.parent) == ["out"]


def test_nothing_is_left_when_the_block_raises(tmp_path: Path):
    with pytest.raises(RuntimeError, match="half-way"), writing(tmp_path / "out") as draft:
        stop_half_way(draft)
    assert os.listdir(tmp_path) == []


def test_the_old_content_stays_when_the_block_raises(tmp_path: Path):
    before = content(fill(tmp_path / "out"))
    with pytest.raises(RuntimeError, match="half-way"), writing(tmp_path / "out", force=True) as draft:
        stop_half_way(draft)
    assert content(tmp_path / "out") == before
    assert os.listdir(tmp_path) == ["out"]


def test_an_existing_output_is_refused(tmp_path: Path):
    before = content(fill(tmp_path / "out"))
    with pytest.raises(OutputError, match="exists already") as caught, writing(tmp_path / "out"):
        pytest.fail("the block must not run")
    assert "--force" in caught.value.fix
    assert content(tmp_path / "out") == before


def test_force_replaces_all_of_the_old_content(tmp_path: Path):
    fill(tmp_path / "out")
    with writing(tmp_path / "out", force=True) as draft:
        (draft / "new").write_bytes(b"1")
    assert content(tmp_path / "out") == {"new": b"1"}
    assert os.listdir(tmp_path) == ["out"]


def test_force_replaces_a_file(tmp_path: Path):
    (tmp_path / "out").write_text("a file")
    with writing(tmp_path / "out", force=True) as draft:
        (draft / "new").touch()
    assert content(tmp_path / "out") == {"new": b""}
    assert os.listdir(tmp_path) == ["out"]


def test_a_relative_output_does_not_follow_a_change_of_directory(tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with writing(Path("out")) as draft:
        (tmp_path / "elsewhere").mkdir()
        os.chdir(tmp_path / "elsewhere")
        (draft / "new").touch()
    assert (tmp_path / "out/new").is_file()


@pytest.mark.parametrize("name", ["out", "run[1]", "*"])
def test_the_draft_of_a_dead_process_is_swept(tmp_path: Path, name: str):
    child = subprocess.Popen([sys.executable, "-c", ""])
    child.wait()
    stale = tmp_path / f".{name}.tmp-{child.pid}-0badcafe"
    fill(stale)
    with writing(tmp_path / name) as draft:
        (draft / "new").touch()
    assert os.listdir(tmp_path) == [name]


def test_the_draft_of_another_output_is_left_alone(tmp_path: Path):
    fill(tmp_path / ".other.tmp-999999999-0badcafe")
    with writing(tmp_path / "out") as draft:
        (draft / "new").touch()
    assert sorted(os.listdir(tmp_path)) == [".other.tmp-999999999-0badcafe", "out"]


def test_a_draft_that_another_sweep_takes_away_is_not_alive(tmp_path: Path):
    assert not _is_alive(tmp_path / ".out.tmp-999999999-0badcafe")


def test_the_draft_of_a_living_process_is_left_alone(tmp_path: Path, writer):
    process, draft = writer
    with writing(tmp_path / "out") as own:
        (own / "new").touch()
    assert (draft / "graphs/main.onnx").read_bytes() == b"half of the weights"
    process.communicate("go on\n")
    assert process.returncode == 0
    assert content(tmp_path / "out") == {"main.onnx": b"half of the weights"}


def test_the_draft_of_another_thread_is_left_alone(tmp_path: Path):
    with writing(tmp_path / "out") as first:
        (first / "first").touch()
        with writing(tmp_path / "out") as second:
            (second / "second").touch()
            assert first.is_dir()


def test_a_killed_writer_leaves_nothing_at_the_output_and_the_next_run_succeeds(tmp_path: Path, writer):
    process, draft = writer
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert draft.is_dir()
    assert not (tmp_path / "out").exists()
    with writing(tmp_path / "out") as own:
        (own / "new").touch()
    assert content(tmp_path / "out") == {"new": b""}
    assert os.listdir(tmp_path) == ["out"]


def test_a_killed_writer_leaves_the_old_content(tmp_path: Path, writer):
    process, _ = writer
    before = content(fill(tmp_path / "out"))
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert content(tmp_path / "out") == before


def test_an_old_directory_that_a_killed_writer_set_aside_goes_once_there_is_a_new_one(tmp_path: Path):
    fill(tmp_path / "out")
    fill(tmp_path / ".out.old-0badcafe")
    with writing(tmp_path / "out", force=True) as draft:
        (draft / "new").touch()
    assert os.listdir(tmp_path) == ["out"]


@pytest.mark.parametrize(
    ("number", "message"),
    [(errno.ENOSPC, "the disk is full"), (errno.EDQUOT, "the disk quota is used up")],
)
def test_a_full_disk_is_told_and_leaves_nothing(tmp_path: Path, number, message):
    with pytest.raises(OutputError, match=f"Cannot write {tmp_path}/out: {message}"), writing(tmp_path / "out"):
        raise OSError(number, os.strerror(number))
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    ("number", "message"),
    [(errno.EROFS, "the file system is read-only"), (errno.EACCES, "permission denied")],
)
def test_a_place_that_may_not_be_written_to(tmp_path: Path, monkeypatch, number, message):
    def refuse(path: Path, *_args, **_options):
        raise OSError(number, os.strerror(number), str(path))

    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(OutputError, match=message) as caught, writing(tmp_path / "out"):
        pytest.fail("the block must not run")
    assert caught.value.fix


@pytest.mark.parametrize("place", ["file/out", "file/deep/out"])
def test_a_path_under_a_file(tmp_path: Path, place: str):
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="a part of the path is a file"), writing(tmp_path / place):
        pytest.fail("the block must not run")


def test_an_error_of_the_block_that_is_not_about_the_output_stays_itself(tmp_path: Path):
    with pytest.raises(FileNotFoundError), writing(tmp_path / "out"):
        (tmp_path / "absent").read_text()
    with pytest.raises(PermissionError), writing(tmp_path / "out"):
        raise PermissionError(errno.EACCES, "Permission denied", "/somewhere/else")


def test_an_input_beside_the_output_that_may_not_be_read_is_not_blamed_on_the_output(tmp_path: Path):
    source = str(tmp_path / "policy/weights.safetensors")
    with pytest.raises(PermissionError), writing(tmp_path / "out"):
        raise PermissionError(errno.EACCES, "Permission denied", source)
