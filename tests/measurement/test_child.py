from __future__ import annotations

from types import SimpleNamespace

import pytest

from vlatool.bundle.bundle import Bundle
from vlatool.errors import GateFailed, GraphError, MissingExtra, TargetError, UsageError
from vlatool.machine.processes import signal_name
from vlatool.measurement import child
from vlatool.measurement.child import (
    Progress,
    Raised,
    Result,
    answer,
    ask,
    end_error,
    error_of,
    read_line,
    result_of,
)
from vlatool.measurement.cold_start import ColdStart
from vlatool.measurement.jobs import ColdStartJob, Limits


def test_what_a_process_raises_comes_back_as_it_was(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    def fail() -> dict[str, object]:
        raise MissingExtra("onnxruntime is absent.", "pip install it")

    answer(fail)
    line = capsys.readouterr().out
    assert '{"raised": {"kind": "MissingExtra"' in line
    done = SimpleNamespace(stdout="noise\n" + line, stderr="", returncode=0)
    monkeypatch.setattr(child.subprocess, "run", lambda *_, **__: done)
    with pytest.raises(MissingExtra, match="onnxruntime is absent") as caught:
        ask("any", None, Limits, "x")
    assert (caught.value.fix, caught.value.exit_code) == ("pip install it", 4)


def test_a_real_process_says_what_is_wrong(float_bundle: Bundle) -> None:
    with pytest.raises(UsageError, match="Unknown engine 'foo'") as caught:
        ask("vlatool.measurement.cold_start", ColdStartJob(str(float_bundle.path), "foo", 1, 0), ColdStart, "x")
    assert caught.value.exit_code == 2


def test_a_process_that_dies_is_named() -> None:
    with pytest.raises(GraphError, match=r"x cannot be run in a fresh process: .*no_such_module"):
        ask("vlatool.no_such_module", None, Limits, "x")


@pytest.mark.parametrize(
    ("code", "log", "told"),
    [
        (-9, "", "was killed (SIGKILL) while it was measured, as it is when memory runs out"),
        (-11, "noise", "ended with SIGSEGV while it was measured"),
        (3, "first\nlast line", "last line"),
        (1, "", "exit code 1"),
    ],
)
def test_how_a_process_ended_is_told(code, log, told) -> None:
    error = end_error("x", code, log, Limits(), "while it was measured")
    assert isinstance(error, GraphError)
    assert told in error.message


def test_a_process_under_a_limit_did_not_fit_only_where_memory_ended_it() -> None:
    limits = Limits(memory_mb=50)
    assert isinstance(end_error("x", -9, "", limits), GraphError), "something else killed it"
    assert isinstance(end_error("x", 1, "MemoryError", limits), GateFailed)
    error = error_of(Raised("GraphError", "std::bad_alloc"), limits)
    assert isinstance(error, GateFailed)
    assert "more than 50 MB" in error.message


@pytest.mark.parametrize("name", ["annotations", "require", "NoSuchError", "ValueError"])
def test_what_is_no_error_of_vlatool_is_raised_as_the_other_one(name):
    error = error_of(Raised(name, "it broke"), otherwise=TargetError)
    assert (type(error), error.message) == (TargetError, "it broke")


def test_signals_have_names_where_there_are_some():
    assert [signal_name(code) for code in (-9, -40)] == ["SIGKILL", "signal 40"]
    assert "SIGSEGV" in end_error("x", -11, "", Limits()).message


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ('{"result": {"value": {"a": 1}}}\n', Result({"a": 1})),
        ('{"progress": {"what": "opening", "share": null}}', Progress("opening", None)),
        ('{"progress": {"what": 1, "share": null}}', None),
        ('{"result": {"value": {"blocks_ms": [[0.1, 0.', None),
        ('{"a": 1}', None),
        ('{"result": {"value": 1}, "raised": {}}', None),
        ("an engine says hello", None),
        ("[1]", None),
        ("", None),
    ],
)
def test_a_line_that_its_process_did_not_live_to_end_is_no_message(text, wanted) -> None:
    assert read_line(text) == wanted


def test_a_process_that_answers_something_else_is_named() -> None:
    with pytest.raises(
        GraphError, match=r"x: the process does not answer what it was asked: 'answer' lacks 'start_ms'"
    ):
        result_of(Result({}), ColdStart, "x")
