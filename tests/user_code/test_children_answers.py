"""What a policy says in place of the function of vlatool that it shares a process with."""

import pytest

from vlatool.errors import BundleError, MissingExtra, SourceError, VlatoolError
from vlatool.user_code import _answers as answers


@pytest.mark.parametrize(
    "line",
    [
        b'{"progress": 3}', b'{"progress": [1, 2, 3, 4]}', b'{"progress": ["x", "y"]}', b'{"progress": ["x", NaN]}',
        b'{"warning": {}}', b"[" * 200_000, b'[["result", 1]]', b"3", b"{}", b"\xff", b'{"memory": false}',
        b'{"error": "BundleError", "message": 3, "fix": ""}', b'{"error": "VlatoolError", "message": "x"}',
        b'{"errno": "x", "message": "x", "file": null}', b'{"errno": 99999, "message": "x", "file": null}',
        b'{"errno": 32, "message": "x", "file": null}', b'{"errno": true, "message": "x", "file": 3}',
        b'{"raised": "X", "message": "m", "ours": 1}', b'{"raised": null, "message": "m", "ours": true}',
        b'{"raised": "X", "message": "m", "ours": true, "where": 3}', b'{"result": 1, "result": 2}',
    ],
)  # fmt: skip
def test_what_no_child_says_is_nonsense(line: bytes):
    with pytest.raises(SourceError, match=r"The process of the policy \(policy.py\) answered nonsense"):
        answers.read(line, "policy.py")


@pytest.mark.parametrize(
    ("told", "kind", "says"),
    [
        ({"error": "BundleError", "message": "m", "fix": "f"}, BundleError, "^m\n  fix: f$"),
        ({"error": "MissingExtra", "message": "m", "fix": "f"}, MissingExtra, "m"),
        *(
            ({"error": name, "message": "m", "fix": "f"}, SourceError, f"^policy.py failed: {name}: m\n  fix: f$")
            for name in ("GateFailed", "Inconclusive", "VlatoolError", "UsageError")
        ),
        ({"error": "sys", "message": "m\x1b[2J", "fix": "f"}, SourceError, r"^policy.py failed: m \[2J\n  fix: f$"),
        ({"raised": "X", "message": "m", "ours": True}, SourceError, "the process that runs it failed: X: m"),
        ({"raised": "X", "message": "m", "ours": True, "where": ""}, SourceError, "that runs it failed: X: m"),
        (
            {"raised": "X", "message": "m", "ours": True, "where": "vlatool.a.b"},
            SourceError,
            "^vlatool.a.b failed in the process that runs policy.py: X: m.\n",
        ),
        ({"raised": "X", "message": "m", "ours": False}, SourceError, "policy.py raised X: m"),
        ({"errno": 28, "message": "full", "file": None}, OSError, "full"),
        ({"memory": True}, MemoryError, "^$"),
    ],
)
def test_what_was_raised_is_raised_as_what_a_child_may_raise(told, kind, says: str):
    with pytest.raises(kind, match=says) as caught:
        answers.result(told, "policy.py")
    assert type(caught.value) is kind


@pytest.mark.parametrize("told", [
    {"error": "DataError", "message": "z" * 10**6, "fix": "z" * 10**6},
    {"error": "z" * 10**6, "message": "z" * 10**6, "fix": ""},
    {"raised": "z" * 10**6, "message": "z" * 10**6, "ours": True},
    {"raised": "SystemExit", "message": "z" * 10**6, "ours": False},
    {"errno": 2, "message": "z" * 10**6, "file": "z" * 10**6},
], ids=lambda told: next(iter(told)))  # fmt: skip
def test_what_foreign_code_says_is_shortened(told):
    with pytest.raises((VlatoolError, OSError)) as caught:
        answers.result(told, "policy.py")
    assert "zz... (1,000,000 characters)" in str(caught.value)
    assert len(str(caught.value)) < 10_000


@pytest.mark.parametrize("ours", [True, False])
def test_what_fails_in_a_child_of_our_own_code_is_a_bug(ours: bool):
    with pytest.raises(RuntimeError, match="optimize failed in its process: KeyError: 'a'"):
        answers.result({"raised": "KeyError", "message": "'a'", "ours": ours}, "optimize", own=True)
