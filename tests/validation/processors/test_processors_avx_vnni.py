"""AVX-VNNI where the host has AVX512-VNNI instead: each product is what the other instruction says, in every form."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from _confined import Environment, check, confine, environment
from _cpuinfo import HOST, flags
from _sets import SETS

HERE = flags(HOST.read_text()) if HOST.exists() else frozenset()
TARGET = next(each for each in SETS if each.name == "avx2_vnni")

pytestmark = [
    pytest.mark.skipif(shutil.which("gcc") is None, reason="there is no gcc here"),
    pytest.mark.skipif("avx_vnni" not in TARGET.added(HERE), reason="this host has AVX-VNNI, or no AVX512-VNNI"),
]

FORMS = {
    "registers": "{vex} vpdpbusd %ymm11, %ymm2, %ymm1",
    "high registers": "{vex} vpdpbusd %ymm2, %ymm11, %ymm9",
    "128 bits": "{vex} vpdpbusds %xmm11, %xmm2, %xmm9",
    "memory": "{vex} vpdpbusd (%rdx), %ymm2, %ymm9",
    "displacement of 8 bits": "{vex} vpdpbusd 32(%rdx), %ymm2, %ymm9",
    "negative displacement": "{vex} vpdpbusd -32(%rdx), %ymm2, %ymm1",
    "displacement of 32 bits": "{vex} vpdpbusd 512(%rdx), %ymm2, %ymm1",
    "index": "{vex} vpdpbusd 64(%rdx,%r9,8), %ymm2, %ymm1",
    "high base": "{vex} vpdpwssd (%r10), %ymm2, %ymm1",
    "base that needs a displacement": "{vex} vpdpwssd (%r13), %ymm2, %ymm1",
    "index alone": "{vex} vpdpbusd 16(,%rdx,1), %ymm2, %ymm1",
    "relative": "{vex} vpdpbusd constants+8(%rip), %ymm2, %ymm1",
    "others after it": """
        {vex} vpdpwssds %ymm11, %ymm2, %ymm1
        vpaddd constants(%rip), %ymm1, %ymm1
        vpshufd $27, %ymm1, %ymm1
        vpslld $1, %ymm1, %ymm9
        vperm2i128 $1, 32(%rdx), %ymm9, %ymm9
        vpshufb constants(%rip), %ymm1, %ymm1
        {vex} vpdpbusds constants+32(%rip), %ymm9, %ymm1
        vmovd %xmm1, %eax
        vzeroupper
        vpinsrd $1, %eax, %xmm1, %xmm1
        shlx %eax, %eax, %eax
        rorx $3, %eax, %eax
        vpinsrd $2, %eax, %xmm1, %xmm1""",
    "a loop": """
        mov $9, %eax
     1: {vex} vpdpbusd %ymm11, %ymm2, %ymm1
        vpaddd %ymm1, %ymm2, %ymm2
        {vex} vpdpbusd (%rdx), %ymm2, %ymm9
        dec %eax
        jnz 1b""",
    "a jump into it": """
        mov $2, %eax
        {vex} vpdpbusd %ymm11, %ymm2, %ymm1
     1: vpaddd %ymm1, %ymm2, %ymm2
        {vex} vpdpbusd (%rdx), %ymm2, %ymm9
        dec %eax
        jnz 1b""",
}
"""Products in the assembler's words: accumulators in ymm1 and ymm9, operands in ymm2, ymm11 and memory."""
FUNCTION = """
.globl {name}
{name}:
    push %r13
    mov $3, %r9
    mov %rdx, %r10
    mov %rdx, %r13
    vmovdqu (%rdi), %ymm1
    vmovdqu 32(%rdi), %ymm9
    vmovdqu (%rsi), %ymm2
    vmovdqu (%rdx), %ymm11
    {code}
    vmovdqu %ymm1, (%rcx)
    vmovdqu %ymm9, 32(%rcx)
    pop %r13
    ret
"""
CONSTANTS = """
.section .rodata
.balign 32
constants: .byte {values}
"""
COMPARE = """\
import ctypes, random, sys, threading
library, forms = ctypes.CDLL(sys.argv[1]), int(sys.argv[2])
draw = random.Random(7)
wrong = []

def call(name, operands):
    out = (ctypes.c_uint8 * 64)()
    getattr(library, name)(operands, ctypes.byref(operands, 64), ctypes.byref(operands, 256), out)
    return bytes(out)

def compare(number):
    for form in range(forms):
        values = bytes(draw.choice((0, 1, 127, 128, 255, draw.randrange(256))) for _ in range(1024))
        operands = (ctypes.c_uint8 * 1024).from_buffer_copy(values)
        if call(f"vex{form}", operands) != call(f"evex{form}", operands):
            wrong.append(form)

threads = [threading.Thread(target=lambda: [compare(number) for number in range(20)]) for _ in range(8)]
[each.start() for each in threads]
[each.join() for each in threads]
print(sorted(set(wrong)), len(threads))
"""


@pytest.fixture(scope="module")
def confined(tmp_path_factory) -> Environment:
    """A tiny environment, confined to AVX2 with AVX-VNNI."""
    root = tmp_path_factory.mktemp("confined") / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(root)], check=True)
    place = environment(root)
    confine(place, TARGET, HERE, tell=lambda line: None)
    return place


@pytest.fixture(scope="module")
def library(tmp_path_factory) -> Path:
    """Every form twice: as AVX-VNNI encodes it, and as AVX512-VNNI does."""
    folder = tmp_path_factory.mktemp("forms")
    text = "".join(
        FUNCTION.format(name=f"{way}{number}", code=code.replace("{vex}", f"{{{way}}}"))
        for number, code in enumerate(FORMS.values())
        for way in ("vex", "evex")
    )
    values = ", ".join(str(37 * each % 256) for each in range(96))
    source = folder / "forms.s"
    source.write_text(text + CONSTANTS.format(values=values) + '.section .note.GNU-stack,"",@progbits\n')
    done = subprocess.run(
        ["gcc", "-shared", "-o", str(folder / "forms.so"), str(source)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return folder / "forms.so"


def run(place: Environment, code: str, *words: object) -> str:
    done = subprocess.run(
        [str(place.python), "-X", "faulthandler", "-c", code, *map(str, words)],
        capture_output=True,
        text=True,
        check=False,
    )
    return done.stdout.strip() or f"{done.returncode}: {done.stderr}"


def test_every_form_of_a_product_is_carried_out_on_many_threads(confined, library):
    assert run(confined, COMPARE, library, len(FORMS)) == "[] 8"


def test_the_environment_sees_avx_vnni_and_nothing_of_avx512(confined):
    seen = check(confined, TARGET)
    for place in ("CPUID", "/proc/cpuinfo"):
        assert [seen[place][feature] for feature in ("avx2", "avx_vnni", "avx512f")] == [1, 1, 0], place


def test_code_that_was_generated_is_carried_out_wherever_it_stands(confined):
    """A product on a page of its own, across two pages, in a page that is used again, and in a child."""
    assert run(confined, GENERATED) == "[5, 9] [5, 9] [6, 10] 0"


def test_an_instruction_that_is_no_product_still_kills(confined):
    for code in ("c4e26d58c1", "c4e2ed50c1", "c4e26c50c1", "06"):  # a wrong broadcast, W1, no prefix 66, none at all
        done = run(confined, WRONG, code)
        assert done.startswith("-4: "), code
        assert "Illegal instruction" in done, code


GENERATED = """\
import ctypes, mmap, os
libc = ctypes.CDLL(None)
place = mmap.mmap(-1, 1 << 16, prot=7)
start = ctypes.addressof(ctypes.c_char.from_buffer(place))

def function(offset, product):
    # vmovd xmm0, edi; vmovd xmm1, esi; vpxor xmm2, xmm2, xmm2; product; vmovd eax, xmm2; ret
    code = bytes.fromhex("c5f96ec7" "c5f96ece" "c5e9efd2" + product + "c5f97ed0" "c3")
    place[offset : offset + len(code)] = code
    return ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_int, ctypes.c_int)(start + offset)

def both(each):
    return [each(5, 1), each(9, 1)]

bytes_of = "c4e27950d1"  # {vex} vpdpbusd xmm2, xmm0, xmm1
words_of = "c4e27952d1"  # {vex} vpdpwssd
within, across = function(64, bytes_of), function(4096 * 2 - 14, "c4a27950d1")  # X, which means nothing here
print(both(within), both(across), end=" ")
again = function(64, "c5f9fec1" + words_of)  # another function where one was: vpaddd xmm0, xmm0, xmm1 and words
print(both(again), end=" ")
child = os.fork()
if child == 0:
    os._exit(both(within) != both(again) or both(function(512, bytes_of)) != [5, 9])
print(os.waitpid(child, 0)[1])
"""
WRONG = """\
import ctypes, mmap, sys
place = mmap.mmap(-1, 4096, prot=7)
code = bytes.fromhex(sys.argv[1]) + bytes([0xC3])
place[: len(code)] = code
ctypes.CFUNCTYPE(None)(ctypes.addressof(ctypes.c_char.from_buffer(place)))()
print("it ran")
"""
