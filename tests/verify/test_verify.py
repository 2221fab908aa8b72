"""The tiny policy against originals that are right, and against originals of which one part is another."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vlatool.bundle.bundle import Bundle, replace_manifest
from vlatool.cli import main
from vlatool.errors import SourceError, UsageError
from vlatool.render.formats.terminal import TerminalRenderer
from vlatool.report import Report
from vlatool.stage.base import Context
from vlatool.verify import Options, check, verify
from vlatool.verify._compare import _elements
from vlatool.verify._sample import Sample

ORIGINAL = """\
import json
from pathlib import Path

import numpy as np
import torch

from policy import make

HERE = Path(__file__).parent
STATISTICS = json.loads((HERE / "statistics.json").read_text())
WORDS = json.loads((HERE / "vocabulary.json").read_text())["words"]
NETWORK = make().eval()


def normalised(values, name):
    return (values - np.float32(STATISTICS[name]["mean"])) / np.float32(STATISTICS[name]["std"])


def ids(text):
    found = [WORDS.get(word, 1) for word in text.split()][:4]
    return np.array(found + [0] * (4 - len(found)))


def prepared(observation):
    return {
        "image": observation["image"],
        "proprio": normalised(observation["proprio"], "proprio"),
        "instruction": ids(observation["instruction"]),
    }


def network(observation):
    inputs = [torch.from_numpy(np.ascontiguousarray(each))[None] for each in prepared(observation).values()]
    with torch.no_grad():
        return NETWORK(*inputs)[0]


def act(observation):
    action = STATISTICS["action"]
    return network(observation).numpy() * action["std"] + action["mean"]
"""
HOOKS = """

def preprocess(observation):
    return prepared(observation)


def raw(observation):
    return network(observation)
"""


@pytest.fixture(scope="module")
def bundles(source_bundle: Bundle, float_bundle: Bundle) -> dict[str, Bundle]:
    """The tiny policy as torch modules and as graphs."""
    return {"source": source_bundle, "graphs": float_bundle}


@pytest.fixture
def against(policy_dir: Path):
    """A function that writes the original, with a part of it replaced, beside a copy of the policy; its ``act``."""

    def write(*changes: tuple[str, str], hooks: bool = False, more: str = "") -> str:
        text = ORIGINAL + (HOOKS if hooks else "")
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        (policy_dir / "original.py").write_text(text + more)
        return f"{policy_dir / 'original.py'}:act"

    return write


@pytest.fixture(autouse=True)
def _trusted(policy_template: Path) -> None:
    from vlatool.user_code import trust

    trust.allow(policy_template)


def found(bundle: Bundle, against: str, **options: Any) -> Report:
    return verify(bundle, Options(against, **options), Context())


def stages(report: Report) -> dict[str, int]:
    """Stage -> observations that differ there."""
    return {each["stage"].partition(" (")[0]: each["differs"] for each in report.rows[0].details["stage by stage"]}


@pytest.mark.parametrize("kind", ["source", "graphs"])
@pytest.mark.parametrize("hooks", [False, True])
def test_a_wrapper_that_is_right_passes(bundles, against, kind, hooks):
    report = found(bundles[kind], against(hooks=hooks))
    assert report.verdict == "pass"
    assert report.rows[0].value("relative_error_max") < 1e-5
    assert "32 observations" not in report.title
    assert "16 recorded observations" in report.title
    assert set(stages(report).values()) == {0}
    assert len(stages(report)) == (5 if hooks else 1)


MEAN = 'STATISTICS = json.loads((HERE / "statistics.json").read_text())'
WRONG = {
    "statistics of an input": (
        (MEAN, MEAN + "\nSTATISTICS['proprio']['mean'] = [0.3, -0.2, 0.5]"),
        "normalisation of 'proprio'", "With the original's inputs this policy gives the original's actions",
    ),
    "words": (
        ("WORDS.get(word, 1)", "WORDS.get(word, 1) if word != 'red' else 6"),
        "tokenizer of 'instruction'", "nothing else differs",
    ),
    "another image": (
        ('"image": observation["image"]', '"image": observation["image"][::-1]'),
        "normalisation of 'image'", "nothing else differs",
    ),
    "weights": (
        ("NETWORK = make().eval()", "NETWORK = make().eval()\nNETWORK.head.weight.data *= 1.1"),
        "network", "The inputs are the same, the network's output is not",
    ),
    "statistics of the action": (
        ('action["std"] + action["mean"]', 'action["std"] + 0.5'),
        "action", "The network gives the same, so the denormalisation differs",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_the_stage_that_differs_is_named_where_the_original_tells_its_stages(bundles, against, name):
    change, stage, says = WRONG[name]
    report = found(bundles["source"], against(change, hooks=True))
    assert report.verdict == "fail"
    assert says in " ".join(report.summary)
    differing = [each for each, count in stages(report).items() if count]
    assert differing[0] == stage
    assert "define preprocess" not in " ".join(report.summary)


GUESSED = {
    "an input as it is": (('normalised(observation["proprio"], "proprio")', 'np.float32(observation["proprio"])'),
                          "The normalisation of 'proprio' differs: the original takes it as it is"),
    "blue first": (('"image": observation["image"]', '"image": observation["image"][..., ::-1]'),
                   "The channels of 'image' differ"),
    "still normalised": ((' * action["std"] + action["mean"]', " + 0 * action['std'][0]"),
                         "the original gives the network's output as it is"),
    "another unit": (('action["std"] + action["mean"]', 'action["std"] * 1000 + action["mean"]'),
                     "the original's dx is 1000 times"),
    "another mean": (('action["std"] + action["mean"]', 'action["std"] + [0.5, -0.02]'), "plus 0.49"),
}  # fmt: skip


@pytest.mark.parametrize("name", GUESSED)
def test_what_would_make_both_equal_is_named_where_the_original_gives_actions_alone(bundles, against, name):
    change, says = GUESSED[name]
    report = found(bundles["source"], against(change))
    assert report.verdict == "fail"
    assert says in " ".join(report.summary)


def test_one_observation_is_named_in_the_singular(bundles, against):
    report = found(bundles["source"], against(), samples=1)
    assert report.title.endswith("on 1 recorded observation")
    assert {each["first"] for each in report.rows[0].details["stage by stage"]} == {None}


def test_the_terminal_begins_with_numbers_and_has_no_table_without_any(bundles, against):
    shown = TerminalRenderer().render(found(bundles["source"], against(), samples=1))
    assert "variant" not in shown
    assert "Action error max by dimension" in shown


def test_small_errors_keep_their_digits(float_bundle):
    sample = Sample(0, {}, {}, {}, np.zeros(0), np.zeros((4, 2)), np.full((4, 2), 1.23456e-9))
    dx, _ = _elements(float_bundle.manifest.spec, [sample])
    assert (dx["max error"], dx["relative"]) == (1.235e-9, 1.0)


def test_a_quantized_bundle_is_named_as_such(int8_bundle, against):
    report = found(int8_bundle, against(), tolerance=1e-5)
    assert "This bundle is in int8 and float32" not in " ".join(report.summary)
    assert "This bundle is in int8, which alone makes its actions differ" in " ".join(report.summary)


def test_the_network_is_told_where_the_original_tells_some_of_the_inputs(bundles, against):
    network = ("NETWORK = make().eval()", "NETWORK = make().eval()\nfor each in NETWORK.parameters():\n"
               "    each.data *= 1.2")  # fmt: skip
    some = """

def preprocess(observation):
    return {name: value for name, value in prepared(observation).items() if name != "image"}


def raw(observation):
    return network(observation)
"""
    said = " ".join(found(bundles["source"], against(network, more=some)).summary)
    assert "'proprio' and 'instruction' are the same, the network's output is not" in said
    assert "and at 'image', which preprocess() does not return" in said
    assert "is not certain" not in said


def test_what_cannot_be_told_is_not_told(bundles, against):
    report = found(bundles["source"], against(("NETWORK = make().eval()", "NETWORK = make(layers=1)\n"
                                               "for each in NETWORK.parameters():\n    each.data *= 1.2")))  # fmt: skip
    said = " ".join(report.summary)
    assert "Which stage differs is not certain" in said
    assert "define preprocess(observation) and raw(observation)" in said


def test_words_that_one_side_does_not_know_are_named_without_hooks(bundles, against):
    report = found(bundles["source"], against(("WORDS.get(word, 1)", "WORDS.get(word, 1) if word != 'red' else 6")))
    assert "The tokenizer of 'instruction' seems to differ: 1 texts differ always" in " ".join(report.summary)
    assert "'red ball'" in " ".join(report.summary)


def test_elements_have_their_largest_error_and_where_it_is(bundles, against):
    change = ('action["std"] + action["mean"]', 'action["std"] + action["mean"] + [0.25, 0]')
    report = found(bundles["source"], against(change), samples=4)
    dx, dy = report.rows[0].details["action, element by element"]
    assert (dx["element"], dx["unit"], dx["max error"]) == ("dx", "m", pytest.approx(0.25, abs=1e-5))
    assert dy["max error"] < 1e-5
    assert re.search(r"4 of 4 observations differ by more than 0.001, the first is observation 0", report.summary[0])


def test_the_first_observation_that_differs_is_that_of_the_recording(bundles, against):
    text = "    if observation['instruction'] == 'blue box':\n        return np.zeros((4, 2)) + 1.0\n"
    report = found(bundles["source"], against(("def act(observation):\n", "def act(observation):\n" + text)))
    assert "the first is observation 3;" in report.summary[0]


@pytest.mark.parametrize(
    ("part", "steps", "verdict"),
    [
        ("[:2]", 2, "pass"),
        ("[:3]", 3, "pass"),
        ("[None]", 4, "pass"),
        (".tolist()", 4, "pass"),
        ("[0]", 1, "inconclusive"),
        ("[:1]", 1, "inconclusive"),
        ("[:1 if observation['proprio'][0] > 0 else 4]", 1, "inconclusive"),
        ("[:1] + 1.0", 1, "fail"),
    ],
)
def test_what_is_executed_must_have_been_compared(bundles, against, part, steps, verdict):
    """The tiny policy executes 2 of 4 steps; leading steps, a batch axis and lists are actions."""
    given = "    return answer(observation)" + part
    original = against(("def act(", "def answer("), more=f"\n\ndef act(observation):\n{given}\n")
    report = found(bundles["source"], original)
    assert report.verdict == verdict
    assert report.summary[-1].startswith(f"Compared: {steps} of the 4 steps of a chunk, of which 2 are executed, on ")
    assert report.rows[0].get("relative_error_max").note == f"action, in physical units, {steps} of 4 steps"
    assert ("is not decided: 1 of the 2 steps that are executed" in report.summary[0]) == (verdict == "inconclusive")


BAD = {
    "raises": ("raise ValueError('no camera')", r"act\(\) of '.*', on observation 0, failed: ValueError: no camera"),
    "nothing": ("return None", "wanted an array of numbers"),
    "a dict": ("return {'action': 1}", "gives a dict of action; wanted an array of numbers"),
    "too wide": ("return np.zeros((4, 7))", r"gives the shape \[4, 7\]; wanted \[4, 2\]"),
    "too long": ("return np.zeros((9, 2))", r"gives the shape \[9, 2\]"),
    "nan": ("return np.full((4, 2), np.nan)", "gives NaN or infinity on observation 0"),
    "leaves": ("raise SystemExit(0)", "sys.exit"),
    "dies": ("import os; os._exit(0)", "ended"),
    "text": ("return 'left'", "wanted an array of numbers"),
    "bfloat16": ("import torch; return torch.zeros(4, 2, dtype=torch.bfloat16)", "is not an array: .*BFloat16"),
}


@pytest.mark.parametrize("name", BAD)
def test_an_original_that_gives_no_action_is_told(bundles, against, name):
    body, says = BAD[name]
    with pytest.raises(SourceError, match=says):
        found(bundles["source"], against(("def act(observation):\n", f"def act(observation):\n    {body}\n")))


@pytest.mark.parametrize(
    ("body", "says"),
    [("return 5", "gives an? int; wanted a dict|gives a int"), ("return {'depth': 1}", "gives depth; wanted a dict"),
     ("return {}", "gives nothing|gives ; wanted")],
)  # fmt: skip
def test_a_preprocess_that_gives_no_inputs_is_told(bundles, against, body, says):
    more = f"\ndef preprocess(observation):\n    {body}\n"
    with pytest.raises(SourceError, match=says):
        found(bundles["source"], against(more=more))


def test_an_original_that_changes_its_observation_changes_its_own(bundles, against):
    text = "    try:\n        return answer(observation)\n    finally:\n        observation['image'][:] = 0\n"
    original = against(("def act(", "def answer("), hooks=True, more=f"\n\ndef act(observation):\n{text}")
    assert found(bundles["source"], original).verdict == "pass"


def test_without_a_recording_both_run_on_random_observations(copied, bundles, against):
    bundle = copied(bundles["graphs"])
    for path in (bundle.path / "data").iterdir():
        path.unlink()
    (bundle.path / "data").rmdir()
    from dataclasses import replace

    files = {name: each for name, each in bundle.manifest.files.items() if not name.startswith("data/")}
    report = found(replace_manifest(bundle, replace(bundle.manifest, files=files)), against(), samples=3)
    assert report.verdict == "pass"
    assert "3 random observations" in report.title
    assert any("nothing is recorded" in each for each in report.warnings)


def test_a_recording_of_ones_own_is_used(bundles, against, policy_dir):
    report = found(bundles["source"], against(), data=policy_dir / "calibration.npz")
    assert "24 recorded observations" in report.title


@pytest.mark.parametrize("tolerance", [-1.0, 1.0, float("nan")])
def test_a_tolerance_that_makes_no_sense_is_refused(tolerance):
    with pytest.raises(UsageError, match="--tolerance is"):
        check(Options("a.py:b", tolerance=tolerance))


def run(capsys: pytest.CaptureFixture[str], *line: Any) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as left:
        main([str(part) for part in line])
    told = capsys.readouterr()
    return int(left.value.code or 0), told.out, told.err


def test_the_command_exits_by_the_verdict_and_prints_json(capsys, policy_dir, against, monkeypatch):
    against()
    monkeypatch.chdir(policy_dir)
    code, out, err = run(capsys, "verify", ".", "--against", "original.py:act", "--json")
    assert code == 0, err
    assert json.loads(out)["verdict"] == "pass"
    against(('action["std"] + action["mean"]', "9"))
    code, out, err = run(capsys, "verify", ".", "--against", "original.py:act", "--json")
    assert (code, json.loads(out)["verdict"]) == (1, "fail")
    code, out, err = run(capsys, "verify", ".", "--against", "original.py:act")
    assert code == 1
    assert "does not give what original.py:act gives" in out


@pytest.mark.parametrize(
    ("line", "code", "says"),
    [
        (["--against", "original.py"], 3, "add the function: original.py:NAME"),
        (["--against", "nowhere.py:act"], 3, "No such file"),
        (["--against", "original.py:none"], 3, "has no function 'none'"),
        (["--against", "original.py:act", "--data", "none.npz"], 3, "none.npz not found"),
        (["--against", "original.py:act", "--samples", "0"], 2, "samples"),
        (["--against", "original.py:act", "--tolerance", "2"], 2, "--tolerance is 2"),
        (["--against", "os:getcwd"], 3, "standard library"),
        ([], 2, "against"),
    ],
)
def test_wrong_words_are_told(capsys, policy_dir, against, monkeypatch, line, code, says):
    against()
    monkeypatch.chdir(policy_dir)
    left, out, err = run(capsys, "verify", ".", *line)
    assert (left, out) == (code, "")
    assert says in err


def test_discrete_actions_are_compared_by_index(tmp_path, capsys, monkeypatch):
    (tmp_path / "policy.yaml").write_text(
        "schema: 1\nname: turns\nversion: 1.0.0\nsource: policy.py:make\nspec:\n  inputs:\n"
        "    - {name: state, shape: [1, 2]}\n  outputs:\n"
        "    - {name: turn, kind: discrete, shape: [1, 3], labels: [left, ahead, right]}\n  control_hz: 5\n  chunk: 1\n"
    )
    (tmp_path / "policy.py").write_text(
        "import torch\n\n\ndef make():\n    torch.manual_seed(0)\n    return torch.nn.Linear(2, 3)\n"
    )
    random = np.random.default_rng(0)
    np.savez(tmp_path / "calibration.npz", state=random.normal(size=(20, 2)).astype(np.float32))
    (tmp_path / "original.py").write_text(
        "import torch\nfrom policy import make\nNETWORK = make()\n\n\ndef act(observation):\n"
        "    return int(NETWORK(torch.from_numpy(observation['state'])).argmax())\n\n\n"
        "def named(observation):\n    return ['left', 'ahead', 'right'][act(observation)]\n\n\n"
        "def wrong(observation):\n    return 'ahead'\n\n\ndef bad(observation):\n    return 'up'\n"
    )
    monkeypatch.chdir(tmp_path)
    codes = {name: run(capsys, "verify", ".", "--against", f"original.py:{name}") for name in
             ("act", "named", "wrong", "bad")}  # fmt: skip
    assert {name: code for name, (code, _, _) in codes.items()} == {
        "act": 0, "named": 0, "wrong": 1, "bad": 3
    }, codes["act"][2]  # fmt: skip
    assert "wanted an index from 0 to 2, or one of left, ahead, right" in codes["bad"][2]
