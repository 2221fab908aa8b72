"""What ``engine="auto"`` stands for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

import vlatool
from vlatool.bundle.bundle import Bundle, replace_manifest
from vlatool.errors import MissingExtra
from vlatool.runtime import engine_choice
from vlatool.runtime.engine import engine_class
from vlatool.runtime.engine_choice import choose_engine

Copy = Callable[[Bundle], Bundle]


def made_for(bundle: Bundle, engine: str, **changes: object) -> Bundle:
    return replace_manifest(bundle, replace(bundle.manifest, engine=engine, **changes))


def test_the_engine_that_the_bundle_was_made_for_comes_first(float_bundle: Bundle, copied: Copy) -> None:
    policy = vlatool.load(float_bundle.path, engine="auto", threads=1)
    assert (policy.engine, policy.engine_reason) == ("ort_cpu", "the bundle was made for ort_cpu.")
    bundle = made_for(copied(float_bundle), "openvino", made_by={"stage": "optimize", "profile": "intel-nuc-14-pro"})
    choice = choose_engine(bundle.manifest)
    assert (choice.engine, choice.replaces) == ("openvino", "")
    assert choice.reason == "the bundle was made for openvino on intel-nuc-14-pro."
    assert vlatool.load(float_bundle.path, threads=1).engine_reason == ""


@pytest.mark.parametrize("engine", ["openvino_npu", "openvino_gpu", "ort_tensorrt", "ort_cuda"])
def test_another_engine_stands_in_with_a_warning_that_says_why(float_bundle: Bundle, copied: Copy, engine: str) -> None:
    bundle = made_for(copied(float_bundle), engine)
    if engine_class(engine).is_installed():
        pytest.skip("this machine has the device")
    with pytest.warns(RuntimeWarning, match=f"is ort_cpu: the bundle was made for {engine}, which .*: .* no"):
        policy = vlatool.load(bundle.path, engine="auto", threads=1)
    assert policy.engine == "ort_cpu"
    with pytest.raises(MissingExtra):
        vlatool.load(bundle.path, threads=1)


def test_without_any_engine_the_one_that_is_missing_is_named(float_bundle: Bundle, monkeypatch) -> None:
    monkeypatch.setattr(engine_choice, "trouble_of", lambda name: f"{name} is gone.")
    with pytest.raises(MissingExtra, match=r"No engine can be used here; .*ort_cpu: ort_cpu is gone"):
        choose_engine(float_bundle.manifest)
