"""What is fetched for emulation: from where, whether it is whole, and when a registry does not answer."""

import sys

import pytest
from _emulation import (
    ELSE,
    KEYRING,
    EmulationError,
    Emulators,
    Unreachable,
    check_elf,
    check_version,
    mirror,
    silent,
    told,
    whole,
)

APT = "E: Failed to fetch http://mirror/InRelease  Could not connect to 127.0.0.1:9 - connect (111: Connection refused)"
PIP = (
    "WARNING: Retrying (Retry(total=0)) after connection broken by 'NewConnectionError('Failed to establish a new "
    "connection: [Errno 111] Connection refused')': /simple/onnxruntime/\n"
    "ERROR: No matching distribution found for onnxruntime==1.31.1"
)
DNS = "W: Failed to fetch http://mirror/InRelease  Temporary failure resolving 'mirror'"


@pytest.mark.parametrize("stderr", [APT, PIP, DNS, "ERROR: 503 Server Error", "Could not resolve host: pypi.org"])
def test_a_registry_that_does_not_answer_is_told_from_one_that_does(stderr):
    assert silent(stderr) in [line[:200] for line in stderr.splitlines()]


@pytest.mark.parametrize(
    "stderr",
    [
        "E: The repository 'http://mirror nosuch Release' does not have a Release file.",
        "ERROR: No matching distribution found for onnxruntime==9.9.9",
        "E: Unable to locate package qemu-user",
        "E: Failed to fetch http://mirror/qemu.deb  Hash Sum mismatch",
        f"{PIP}\nERROR: THESE PACKAGES DO NOT MATCH THE HASHES FROM THE REQUIREMENTS FILE.",
        "ERROR: Could not install packages due to an OSError: [Errno 28] No space left on device",
        "",
    ],
)
def test_one_that_has_no_such_thing_answers(stderr):
    assert silent(stderr) == ""


def test_a_command_that_fails_says_which_of_both_it_is():
    told([sys.executable, "-c", "pass"], "Debian's mirror")
    fails = [sys.executable, "-c", f"import sys; print({APT!r}, file=sys.stderr); sys.exit(100)"]
    with pytest.raises(Unreachable, match="Debian's mirror does not answer: E: Failed to fetch"):
        told(fails, "Debian's mirror")
    with pytest.raises(EmulationError, match="left with 100") as failed:
        told(fails, "")
    assert not isinstance(failed.value, Unreachable), "unpacking asks no registry"


@pytest.mark.parametrize(
    ("sources", "wanted"),
    [
        ("URIs: http://a.example/debian\nSuites: bookworm\n", "http://a.example/debian"),
        ("deb [signed-by=/k] https://b.example/debian/ bookworm main\n", "https://b.example/debian"),
        ("deb http://c.example/debian-security bookworm main\ndeb http://c.example/debian x main", "http://c.example/debian"),
        ("deb http://archive.ubuntu.com/ubuntu noble main\n", ELSE),
        ("# URIs: http://d.example/debian\n", ELSE),
    ],
)  # fmt: skip
def test_the_mirror_is_the_one_that_this_host_uses(tmp_path, sources, wanted):
    assert mirror(tmp_path) == ELSE
    (tmp_path / "sources.list.d").mkdir()
    (tmp_path / "sources.list.d/a.sources").write_text(sources)
    assert mirror(tmp_path) == wanted


def test_what_is_made_is_there_as_a_whole_or_not_at_all(tmp_path):
    def half(draft):
        draft.mkdir()
        (draft / "file").touch()
        raise EmulationError("no")

    with pytest.raises(EmulationError):
        whole(tmp_path / "a/board", half)
    assert list((tmp_path / "a").iterdir()) == []
    whole(tmp_path / "a/qemu", lambda draft: draft.write_text("x"))
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["qemu"]


def elf(machine: int, size: int = 2_000_000) -> bytes:
    return (b"\x7fELF" + bytes(14) + machine.to_bytes(2, "little")).ljust(size, b"\0")


def test_a_program_of_another_processor_or_the_half_of_one_is_refused(tmp_path):
    file = tmp_path / "python3.11"
    file.write_bytes(elf(183))
    check_elf(file, "aarch64")
    for content in (elf(62), elf(183, 1000), b"<html>not found</html>", b""):
        file.write_bytes(content)
        with pytest.raises(EmulationError, match=r"python3\.11"):
            check_elf(file, "aarch64")
    with pytest.raises(EmulationError, match="no program for aarch64"):
        check_elf(tmp_path / "none", "aarch64")


def test_an_old_qemu_is_refused():
    check_version("qemu-aarch64 version 10.0.8 (Debian 1:10.0.8+ds-0)\nCopyright", 10)
    for text in ("qemu-aarch64 version 7.2.17 (Debian)", "", "Segmentation fault"):
        with pytest.raises(EmulationError, match="version 10 is needed"):
            check_version(text, 10)


def test_what_is_there_already_is_not_fetched(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", "")
    (tmp_path / "qemu-aarch64").touch()
    (tmp_path / "board").mkdir()
    cache = Emulators(tmp_path)
    assert cache.emulated("aarch64", "cortex-a72") == [
        str(tmp_path / "qemu-aarch64"), "-cpu", "cortex-a72", "-L", str(tmp_path / "board"),
    ]  # fmt: skip
    with pytest.raises(EmulationError, match=f"is not installed|{KEYRING.name}"):
        cache.qemu("x86_64")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["board", "qemu-aarch64"]
