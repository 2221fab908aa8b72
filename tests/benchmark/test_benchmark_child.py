from __future__ import annotations

from types import SimpleNamespace

import pytest

from vlatool.benchmark import _child
from vlatool.benchmark._child import SAID, answer, ask
from vlatool.bundle import Bundle
from vlatool.errors import GraphError, MissingExtra, UsageError


def test_what_a_process_raises_comes_back_as_it_was(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    def fail() -> dict[str, object]:
        raise MissingExtra("onnxruntime is absent.", "pip install it")

    answer(fail)
    line = capsys.readouterr().out
    assert f'"{SAID}": "MissingExtra"' in line
    done = SimpleNamespace(stdout="noise\n" + line, stderr="", returncode=0)
    monkeypatch.setattr(_child.subprocess, "run", lambda *_, **__: done)
    with pytest.raises(MissingExtra, match="onnxruntime is absent") as caught:
        ask("any", (), "", "x")
    assert (caught.value.fix, caught.value.exit_code) == ("pip install it", 4)


def test_a_real_process_says_what_is_wrong(float_bundle: Bundle) -> None:
    with pytest.raises(UsageError, match="There is no engines 'foo'") as caught:
        ask("vlatool.benchmark._probe", (str(float_bundle.path), "foo", "1"), "", "x")
    assert caught.value.exit_code == 2


def test_a_process_that_dies_is_named() -> None:
    with pytest.raises(GraphError, match=r"x cannot be run in a fresh process: .*no_such_module"):
        ask("vlatool.no_such_module", (), "", "x")
