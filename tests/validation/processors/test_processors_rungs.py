"""Which instruction sets a host can be restricted to."""

import pytest
from _rungs import RUNGS, flags, model

from vlatool.machine.host import MAX_CPU_ISA
from vlatool.machine.instruction_sets import RUNGS as SETS

LINES = """\
processor\t: {number}
model name\t: A processor
flags\t\t: fpu avx avx2 {more}
bugs\t\t: spectre_v1
"""
SERVER = "".join(LINES.format(number=n, more="avx512f avx512bw avx512dq avx512vl avx512_vnni") for n in (0, 1))
LAPTOP = LINES.format(number=0, more="avx_vnni avx512_vnni") + LINES.format(number=1, more="avx_vnni")


def test_flags_are_those_that_every_core_has():
    assert "avx512_vnni" in flags(SERVER)
    assert flags(LAPTOP) == {"fpu", "avx", "avx2", "avx_vnni"}
    assert flags("processor : 0\nFeatures : fp asimd\n") == frozenset()


@pytest.mark.parametrize(
    ("text", "untried"),
    [
        (SERVER, {"AVX2_VNNI": ("avx_vnni",)}),
        (LAPTOP, {
            "AVX512_CORE": ("avx512f", "avx512bw", "avx512dq", "avx512vl"),
            "AVX512_CORE_VNNI": ("avx512f", "avx512bw", "avx512dq", "avx512vl", "avx512_vnni"),
        }),
        ("", {
            "AVX512_CORE": ("avx512f", "avx512bw", "avx512dq", "avx512vl"),
            "AVX512_CORE_VNNI": ("avx512f", "avx512bw", "avx512dq", "avx512vl", "avx512_vnni"),
            "AVX2_VNNI": ("avx2", "avx_vnni"), "AVX2": ("avx2",),
        }),
    ],
    ids=["server", "laptop", "nothing"],
)  # fmt: skip
def test_a_rung_is_tried_where_the_host_has_what_it_needs(text, untried):
    """oneDNN would silently take the next lower set."""
    lacking = {rung.name: rung.lacking(flags(text)) for rung in RUNGS}
    assert {name: lacks for name, lacks in lacking.items() if lacks} == untried


def test_a_rung_is_a_variable_or_an_emulated_processor_or_the_host():
    for rung in RUNGS:
        assert rung.variables == ({MAX_CPU_ISA: rung.name} if rung.name.startswith("AVX") else {})
        assert bool(rung.cpu) == ("QEMU" in rung.name)
    assert {rung.engine for rung in RUNGS if rung.name == "host"} == {"ort_cpu", "openvino"}


def test_a_set_needs_here_what_it_needs_there():
    for rung in RUNGS:
        assert not rung.isa or SETS[rung.isa] in rung.needs


def test_a_processor_is_named_with_what_it_has():
    assert model(SERVER) == "A processor (avx512_vnni, avx512f, avx2)"
    assert model("") == "a processor without a name (without AVX2)"
