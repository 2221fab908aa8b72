"""Bundles made under each set and loaded under each other: which sets are tried, and what is wrong."""

import json
import shutil

import makes
import numpy as np
import pytest
import sets_table
from _asked import Answer
from _sets import SETS, RefusedError
from _variants import FLOAT, FOR_X86, Made, VariantError
from sets_table import TableError, chosen, confined, row

ALONE = frozenset(["ssse3", "sse4_1", "sse4_2", "popcnt", "avx", "f16c", "fma", "avx2"])
LAPTOP = ALONE | {"avx_vnni"}
SERVER = ALONE | frozenset(
    ["avx512f", "avx512cd", "avx512bw", "avx512dq", "avx512vl", "avx512_vnni", "amx_tile", "amx_int8"]
)
ACTIONS = np.arange(1.0, 7.0).reshape(2, 3)


@pytest.mark.parametrize(
    ("has", "wanted"),
    [
        (ALONE, ["avx"]),
        (LAPTOP, ["avx2"]),
        (LAPTOP | SERVER, ["avx2", "avx2_vnni", "avx512", "avx512_vnni"]),
        (SERVER, ["avx2", "avx2_vnni", "avx512", "avx512_vnni"]),
        (frozenset(), []),
    ],
    ids=["avx2", "laptop", "both", "server", "nothing"],
)
def test_the_sets_beside_the_host_hide_something_that_it_has(has, wanted):
    """The host itself is tried as well: AVX2 alone is not another set on a host with AVX2 alone."""
    assert [each.name for each in chosen([], has)] == wanted


def test_a_set_that_was_named_is_tried_or_refused():
    assert [each.name for each in chosen(["avx2", "sse42"], ALONE)] == ["avx2", "sse42"]
    with pytest.raises(RefusedError):
        chosen(["avx512"], ALONE)


@pytest.mark.parametrize(
    ("answer", "verdict"),
    [
        (Answer(ACTIONS), "ok"),
        (Answer(ACTIONS * 1.2, "GraphError", "another golden action"), "refused"),
        (Answer(None, "GraphError", "does not open"), "refused"),
        (Answer(ACTIONS * 1.2), "WRONG"),
        (Answer(None, "crash", "SIGILL"), "WRONG"),
        (Answer(ACTIONS, "MissingExtra", "no openvino"), "WRONG"),
    ],
)
def test_actions_are_as_promised_or_refused_or_wrong(answer, verdict):
    assert row(("avx2", "host", "openvino", "p"), FLOAT, answer, ACTIONS).verdict == verdict


def test_an_environment_that_is_missing_is_a_sentence(tmp_path, capsys, monkeypatch):
    with pytest.raises(TableError, match="make confined SET=avx2"):
        confined(SETS[2], tmp_path)
    monkeypatch.setattr(sets_table, "flags", lambda text: ALONE)
    assert sets_table.main(["-o", str(tmp_path)]) == 2
    told = capsys.readouterr()
    assert told.err == f"make sets: there is no {tmp_path}/avx/venv: make confined SET=avx\n"
    assert sets_table.main(["--names"]) == 0
    assert capsys.readouterr().out == "avx\n"


def test_an_environment_that_is_not_confined_is_not_tried(tmp_path):
    python = tmp_path / "avx/venv/bin/python"
    python.parent.mkdir(parents=True)
    python.write_text("#!/bin/sh\nexit 1\n")
    python.chmod(0o755)
    with pytest.raises(TableError, match="is not confined to avx"):
        confined(next(each for each in SETS if each.name == "avx"), tmp_path)


def test_the_usual_variants_are_some_of_all():
    assert {*sets_table.VARIANTS} < {each.name for each in FOR_X86}


def test_a_bundle_with_a_finding_is_tried_and_what_an_earlier_run_left_is_refused(tmp_path, capsys, monkeypatch):
    def make(source, variants, out, count):
        for name in ("float32", "dynamic-int8"):
            (out / name).mkdir(parents=True)
            (out / name / "manifest.json").touch()
        return Made("p", {}, {"dynamic-int8": "wrong", "ort uint8": "no"}, out / "observations.npz", 1, 1)

    monkeypatch.setattr(makes, "make", make)
    words = ["p", "-o", str(tmp_path / "made"), "--variants", "float32", "dynamic-int8", "ort uint8"]
    assert makes.main(words) == 0
    told = json.loads(capsys.readouterr().out)
    assert sorted(told["bundles"]) == ["dynamic-int8", "float32"]
    assert told["refused"] == {"ort uint8": "no"}

    assert makes.main(words) == 1
    assert "is not empty" in capsys.readouterr().err
    shutil.rmtree(tmp_path / "made")

    def fail(*words):
        raise VariantError("p cannot be exported: no")

    monkeypatch.setattr(makes, "make", fail)
    assert makes.main(words) == 1
    assert capsys.readouterr().err == "p cannot be exported: no\n"
