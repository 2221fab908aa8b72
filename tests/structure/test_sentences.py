"""No verdict is decided by a sentence."""

from __future__ import annotations

from pathlib import Path

import pytest
from sentences import decisions


def test_no_verdict_rests_on_a_sentence():
    assert decisions() == []


@pytest.mark.parametrize("planted", [
    'FAILS = "The reference fails"\nfails = sentence.startswith(FAILS)',
    "from vlatool.words import FAILS\nfails = FAILS in text",
    "from vlatool import words\nfails = text.endswith(words.FAILS)",
    'fails = told == "does not do its task"', 'fails = f"{name} does not do its task" in told',
    'fails = result.sentence.startswith("The")', 'worst = row.note.partition(",")[0]', "known = path in error.message",
    'late = line["note"] == LATE', 'fails = re.search("fails", verdict.sentence)',
    'fails = told in ("not measured", "too few episodes")',
])  # fmt: skip
@pytest.mark.parametrize("room", ["gate/claims", "optimize"])
def test_a_planted_decision_is_found(tmp_path: Path, room: str, planted: str):
    file = tmp_path / "vlatool" / room / "planted.py"
    file.parent.mkdir(parents=True)
    file.write_text(f"def late():\n    {planted.splitlines()[-1]}\n" if "\n" not in planted else planted + "\n")
    (tmp_path / "vlatool/words.py").write_text('FAILS = "The reference fails"\n')
    (tmp_path / "vlatool/__init__.py").touch()
    (found,) = decisions(tmp_path)
    assert found.startswith(f"{room}/planted.py:2: ")


@pytest.mark.parametrize("fine", [
    "fails = verdict.outcome is Outcome.FAIL", 'fails = row.role == "chosen"', 'words = f"{name} does not do its task"',
    'own = name.startswith("latency_")', 'known = "latency" in claims', "fails = any(sentences)",
])  # fmt: skip
def test_values_and_names_are_not_sentences(tmp_path: Path, fine: str):
    (tmp_path / "vlatool/gate").mkdir(parents=True)
    (tmp_path / "vlatool/gate/fine.py").write_text(fine + "\n")
    assert decisions(tmp_path) == []
