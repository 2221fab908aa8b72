"""Environments confined to an instruction set: what is replaced, who is confined, and what is refused."""

import shutil
import subprocess
import sys
from pathlib import Path

import _confined
import _cpuid
import confine as command
import pytest
from _confined import Environment, UnconfinedError, check, confine, environment, faults, header
from _cpuinfo import HOST, flags
from _sets import BFLOAT16, EXACT_INT8, FEATURES, SETS, RefusedError, distinct, listing, masks, named, possible

ALONE = frozenset(["ssse3", "sse4_1", "sse4_2", "popcnt", "avx", "f16c", "fma", "avx2", "vaes", "vpclmulqdq"])
SERVER = ALONE | frozenset(
    ["avx512f", "avx512cd", "avx512bw", "avx512dq", "avx512vl", "avx512_vnni", "avx512_bf16", "amx_tile", "amx_int8"]
)
BY_NAME = {each.name: each for each in SETS}
HERE = flags(HOST.read_text()) if HOST.exists() else frozenset()
CODE = """\
#include <cpuid.h>
int constant(void) { int found; __asm__ volatile("movl $0xa20f, %0" : "=r"(found)); return found; }
void ask(unsigned leaf, unsigned subleaf, unsigned found[4]) {
  __cpuid_count(leaf, subleaf, found[0], found[1], found[2], found[3]);
}
"""
HAS_AVX2 = """\
import ctypes
found = (ctypes.c_uint * 4)()
library = ctypes.CDLL({library!r})
library.ask(ctypes.c_uint(7), ctypes.c_uint(0), found)
print(found[1] >> 5 & 1, " avx2 " in open("/proc/cpuinfo").read(), library.constant() == 0xA20F)
"""
needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="there is no gcc here")
needs_avx2 = pytest.mark.skipif("avx2" not in HERE, reason="this host has no AVX2 that could be hidden")


def library(path: Path) -> Path:
    """A shared library with one CPUID, and one constant that looks like it."""
    source = path.with_suffix(".c")
    source.write_text(CODE)
    subprocess.run(["gcc", "-O2", "-shared", "-fPIC", "-o", str(path), str(source)], check=True)
    return path


def test_a_set_hides_what_it_does_not_keep():
    hidden = {name: each.hidden & SERVER for name, each in BY_NAME.items()}
    assert hidden["avx512_vnni"] == {"avx512_bf16", "amx_tile", "amx_int8"}
    assert hidden["avx512"] == {"avx512_vnni", *hidden["avx512_vnni"]}
    assert hidden["avx2"] == SERVER - ALONE == hidden["avx2_vnni"]
    assert hidden["avx"] == {*hidden["avx2"], *["f16c", "fma", "avx2", "vaes", "vpclmulqdq"]}
    assert "avx_vnni" in BY_NAME["avx2"].hidden - BY_NAME["avx2_vnni"].hidden


def test_a_host_is_confined_to_what_it_has_alone():
    assert [each.name for each in possible(ALONE)] == ["sse42", "avx", "avx2"]
    assert [each.name for each in distinct(ALONE)] == ["sse42", "avx"], "avx2 is this host itself"
    assert [each.name for each in possible(SERVER)] == [each.name for each in SETS], "its AVX512-VNNI does for AVX-VNNI"
    assert [each.added(SERVER) for each in SETS if each.added(SERVER)] == [("avx_vnni",)]
    assert BY_NAME["avx2_vnni"].added(SERVER | {"avx_vnni"}) == () == BY_NAME["avx2_vnni"].added(SERVER - {"avx512vl"})
    with pytest.raises(RefusedError, match=r"lacks avx_vnni \(or avx512_vnni and avx512vl\); .* to sse42, avx, avx2\."):
        named("avx2_vnni", ALONE)
    with pytest.raises(RefusedError, match="there is no set 'avx3'; the sets are sse42"):
        named("avx3", ALONE)
    with pytest.raises(RefusedError, match="none of the sets"):
        named("avx2", frozenset())
    assert [line.split()[1].rstrip(":;") for line in listing(ALONE)] == ["yes"] * 3 + ["no"] * 3
    assert "avx2_vnni    yes, with avx512_vnni for avx_vnni; needs" in listing(SERVER)[3]


def test_a_feature_is_hidden_by_its_bit_and_leaves_that_describe_it_are_emptied():
    found = masks(["avx512f", "amx_tile"])
    assert found[7, 0] == (0, 1 << 16, 0, 1 << 24)
    assert {place[0] for place in found} == {0x7, 0x1D, 0x1E}
    assert masks([]) == {}
    text = header(BY_NAME["avx2"], Path("/e/hide.so"), HERE)
    assert '"avx512_vnni"' in text
    assert '"avx2"' not in text
    added = {name: header(each, Path("/e/hide.so"), SERVER).count("AVX_VNNI 1") for name, each in BY_NAME.items()}
    assert added == {name: int(name == "avx2_vnni") for name in BY_NAME}


def test_libraries_may_not_see_what_is_hidden_and_have_to_see_the_rest():
    right = {"a": {"avx2": True, "avx512f": False, EXACT_INT8: False, BFLOAT16: False, "vaes": True}, "b": {}}
    assert faults(right, BY_NAME["avx2"]) == []
    assert faults({"torch": {"avx2": True}}, BY_NAME["avx"]) == ["torch still sees avx2"]
    assert faults({"x": {EXACT_INT8: True}}, BY_NAME["avx2"]) == [f"x still sees {EXACT_INT8}"]
    assert faults({"x": {EXACT_INT8: False}}, BY_NAME["avx2_vnni"]) == [
        f"x does not see {EXACT_INT8}, which avx2_vnni has"
    ]
    assert faults({"x": {"error": "ImportError: no"}}, BY_NAME["avx"]) == ["x cannot be asked (ImportError: no)"]
    assert {*BY_NAME["sse42"].hidden} == {*FEATURES}


@needs_gcc
def test_a_constant_that_looks_like_cpuid_stays(tmp_path):
    path = library(tmp_path / "tiny.so")
    content = path.read_bytes()
    found = _cpuid.search(path)
    assert (len(found.instructions), found.others) == (1, 1)
    _cpuid.replace(path, found.instructions)
    changed = [index for index, (one, other) in enumerate(zip(content, path.read_bytes(), strict=True)) if one != other]
    assert changed == [found.instructions[0] + 1]
    assert _cpuid.search(path) == _cpuid.Found((), 1)


def test_what_is_not_a_library_has_no_cpuid(tmp_path):
    for content in (b"", b"text \x0f\xa2", b"\x7fELF"):
        (tmp_path / "x.so").write_bytes(content)
        assert _cpuid.search(tmp_path / "x.so").instructions == ()


@pytest.fixture(scope="module")
def confined(tmp_path_factory) -> Environment:
    """A tiny environment, confined to AVX, with one library in it."""
    root = tmp_path_factory.mktemp("confined") / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(root)], check=True)
    place = environment(root)
    library(site(place) / "tiny.so")
    assert confine(place, BY_NAME["avx"], HERE, tell=lambda line: None) == 2
    return place


def site(place: Environment) -> Path:
    return next(place.root.glob("lib/python3*/site-packages"))


def asked(place: Environment, *words: str, library: str = "tiny.so", env: dict[str, str] | None = None) -> str:
    code = HAS_AVX2.format(library=str(site(place) / library))
    python = [str(place.python), *words]
    done = subprocess.run([*python, "-c", code], capture_output=True, text=True, env=env, check=False)
    return done.stdout.strip() or done.stderr


@needs_gcc
@needs_avx2
def test_a_library_and_whoever_reads_cpuinfo_see_no_avx2(confined):
    assert asked(confined) == "0 False True"
    assert asked(confined, "-I", "-S", "-X", "faulthandler", env={}) == "0 False True"
    seen = check(confined, BY_NAME["avx"])
    assert (seen["CPUID"]["avx2"], seen["CPUID"]["avx"], seen["/proc/cpuinfo"]["avx2"]) == (False, True, False)


@needs_gcc
@needs_avx2
def test_every_way_to_read_cpuinfo_is_masked_and_other_programs_are_left_alone(confined):
    code = """if True:
        import io, os, pathlib, subprocess, sys
        path, own = "/proc/cpuinfo", "; print(open('/proc/cpuinfo').read().count(' avx2 '))"
        number = os.open(path, os.O_RDONLY)
        texts = [open(path, "rb").read(), io.FileIO(path).readall(), os.read(number, 1 << 22),
                 pathlib.Path(path).read_bytes(), pathlib.Path(path).read_text().encode()]
        child = subprocess.check_output([sys.executable, "-I", "-c", "pass" + own], env={})
        print([text.count(b" avx2 ") for text in texts], len({text.count(b" sse4_2 ") for text in texts}),
              int(child), int(subprocess.check_output(["grep", "-c", " avx2 ", path])) > 0, "LD_PRELOAD" in os.environ)
    """
    done = subprocess.run([str(confined.python), "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "[0, 0, 0, 0, 0] 1 0 True False", done.stderr


@needs_gcc
@needs_avx2
@pytest.mark.parametrize(
    "before",
    [
        "import faulthandler; faulthandler.enable(); faulthandler.disable()",
        "import signal; signal.signal(signal.SIGILL, signal.SIG_IGN)",
        "import signal; signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())",
        "import ctypes, mmap; place = mmap.mmap(-1, 65536); at = ctypes.addressof(ctypes.c_char.from_buffer(place)); "
        "ctypes.CDLL(None).sigaltstack((ctypes.c_size_t * 3)(at, 0, 65536), None); "
        "ctypes.CDLL(None).munmap(ctypes.c_void_p(at), ctypes.c_size_t(65536))",
    ],
    ids=["faulthandler", "ignored", "blocked", "a stack that is gone"],
)
def test_nothing_takes_the_trap_away(confined, before):
    code = f"{before}\n{HAS_AVX2.format(library=str(site(confined) / 'tiny.so'))}"
    code += "import os, sys; sys.stdout.flush(); os._exit(0)"  # nothing is cleared up, the stack least of all
    done = subprocess.run([str(confined.python), "-c", code], capture_output=True, text=True, check=False)
    assert (done.stdout.strip(), done.returncode) == ("0 False True", 0), done.stderr


@needs_gcc
@needs_avx2
def test_a_real_illegal_instruction_still_kills(confined):
    for words in ([], ["-X", "faulthandler"]):
        code = "import os, signal; os.kill(os.getpid(), signal.SIGILL)"
        done = subprocess.run([str(confined.python), *words, "-c", code], capture_output=True, text=True, check=False)
        assert done.returncode == -4
        assert ("Illegal instruction" in done.stderr) == bool(words)


@needs_gcc
@needs_avx2
def test_confined_again_changes_what_is_new_alone(confined):
    told: list[str] = []
    assert confine(confined, BY_NAME["avx"], HERE, told.append) == 0
    fresh = library(site(confined) / "fresh.so")
    assert asked(confined, library="fresh.so") == "1 False True", "a package that was installed since is not confined"
    assert confine(confined, BY_NAME["avx"], HERE, told.append) == 1
    assert asked(confined, library="fresh.so") == "0 False True"
    library(fresh)
    assert confine(confined, BY_NAME["avx"], HERE, told.append) == 1, "another version of it"
    assert len(told) == 2
    assert "fresh.so: 1 CPUID replaced, 1 look-alikes left" in told[0]
    fresh.unlink()


@needs_gcc
@needs_avx2
def test_an_environment_made_in_a_confined_one_is_that_of_the_host(confined, tmp_path):
    subprocess.run([str(confined.python), "-m", "venv", "--without-pip", str(tmp_path / "new")], check=True)
    code = "print(open('/proc/cpuinfo').read().count(' avx2 ') > 0)"
    done = subprocess.run([str(tmp_path / "new/bin/python"), "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout == "True\n", done.stderr


@needs_gcc
@needs_avx2
def test_a_library_that_is_not_confined_is_noticed(confined, capsys, monkeypatch):
    probe = confined.folder / "probe.so"
    monkeypatch.setattr(_confined, "patched", lambda place, tell: 0)
    kept = probe.read_bytes()
    library(probe)
    try:
        with pytest.raises(UnconfinedError, match=r"CPUID still sees .*avx2"):
            check(confined, BY_NAME["avx"])
        assert command.main([str(confined.root), "avx"]) == 1
    finally:
        probe.write_bytes(kept)
    assert "is not confined to avx: CPUID still sees" in capsys.readouterr().err


def test_an_environment_that_does_not_start_is_not_confined(tmp_path):
    place = Environment(tmp_path)
    place.python.parent.mkdir()
    place.python.write_text("#!/bin/sh\necho broken >&2; exit 3\n")
    place.python.chmod(0o755)
    with pytest.raises(UnconfinedError, match="ended with 3: broken"):
        check(place, BY_NAME["avx"])


@pytest.fixture
def plain(tmp_path) -> Path:
    """What looks like a virtual environment."""
    (tmp_path / "venv/bin").mkdir(parents=True)
    (tmp_path / "venv/lib").mkdir()
    (tmp_path / "venv/bin/python").symlink_to(sys.executable)
    base = Path(sys._base_executable).resolve()  # type: ignore[attr-defined]
    version = ".".join(map(str, sys.version_info[:3]))
    (tmp_path / "venv/pyvenv.cfg").write_text(f"home = {base.parent}\nversion = {version}\n")
    return tmp_path / "venv"


def said(capsys, *words: str) -> str:
    """The sentence with which the command refuses."""
    assert command.main(words) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.count("\n") == 1
    return told.err


def test_wrong_input_is_a_sentence_and_exit_code_2(plain, capsys, monkeypatch):
    monkeypatch.setattr(command, "flags", lambda text: ALONE)
    assert "no set 'foo'" in said(capsys, str(plain), "foo")
    assert "cannot be confined to avx2_vnni" in said(capsys, "--able", "avx2_vnni")
    assert "is not a virtual environment" in said(capsys, str(plain / "none"), "avx2")
    with pytest.raises(SystemExit) as ended:
        command.main([str(plain)])
    assert ended.value.code == 2


def test_what_confining_needs_is_named(plain, capsys, monkeypatch):
    monkeypatch.setattr(command, "flags", lambda text: ALONE)
    with monkeypatch.context() as patch:
        patch.setattr(_confined.os, "access", lambda path, how: Path(path).name != "bin")
        assert "bin cannot be written" in said(capsys, str(plain), "avx2")
    with monkeypatch.context() as patch:
        patch.setattr(_confined, "can_import", lambda name: False)
        assert "install capstone and pyelftools" in said(capsys, str(plain), "avx2")
    with monkeypatch.context() as patch:
        patch.setattr(_confined.platform, "machine", lambda: "aarch64")
        assert "this is linux on aarch64" in said(capsys, str(plain), "avx2")
    monkeypatch.setenv("PATH", "")
    assert "there is no gcc" in said(capsys, str(plain), "avx2")
    assert (plain / "bin/python").is_symlink(), "what was refused is as it was"
    (plain / "pyvenv.cfg").write_text("home = /none\nversion = 3.11.0\n")
    assert "does not exist" in said(capsys, str(plain), "avx2")
    shutil.move(plain, plain.with_name("a venv"))
    assert "holds a blank or a colon" in said(capsys, str(plain.with_name("a venv")), "avx2")


def test_the_sets_are_listed(capsys, monkeypatch):
    monkeypatch.setattr(command, "flags", lambda text: ALONE)
    assert command.main(["--list"]) == 0
    assert "avx2_vnni    no: this host lacks avx_vnni" in capsys.readouterr().out
    assert command.main(["--able", "avx"]) == 0
    assert capsys.readouterr().out == ""
