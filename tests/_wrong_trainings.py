"""What a person can get wrong when distilling: rows of the table of wrong inputs.

The stage runs in this process, without a child of its own; episodes are played in children, as always.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from _tiny import observations
from _wrong_inputs import Line, Place, Row

from vlatool.bundle.bundle import Bundle, seal
from vlatool.prune.neurons import Neurons
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context
from vlatool.stage.run import run_transform

ALONE = ["--episodes", 0, "--student-episodes", 0]
PLAYED = ["--episodes", 2, "--student-episodes", 0]
FORWARD = "        return self.head(self.blocks(tokens).mean(1)).reshape(1, 4, 2)\n"
WIDER = """\
        two = self.head(self.blocks(tokens).mean(1)).reshape(1, 4, 2)
        return torch.cat([two, two[..., :1]], -1)
"""
WHOLE_FAILS = """\
        lost = 0 if self.blocks[0].mlp[1].out_features < 32 else float("nan")
        return self.head(self.blocks(tokens).mean(1)).reshape(1, 4, 2) + lost
"""
EXPLODING = """\
        self.start = getattr(self, "start", self.head.bias.detach().clone())
        size = torch.exp((self.head.bias - self.start).abs().sum() * 40)
        return self.head(self.blocks(tokens).mean(1)).reshape(1, 4, 2) * size
"""


RECORDINGS = ("calibration.npz", "evaluation.npz")
"""Of the tiny policy: they hold actions of its own shape."""


class Workshop(Place):
    """Makes wrong policies, recordings and environments."""

    def __init__(self, root: Path, policy: Path, pruned: Bundle, monkeypatch: pytest.MonkeyPatch) -> None:
        super().__init__(root)
        self.template, self.pruned, self.patch = policy, pruned, monkeypatch

    def line(self, *options: Any, source: Any = None, trust: Any = None) -> Line:
        """Distil the pruned policy, or another bundle, for three steps."""
        short = ["--steps", 3, "--batch", 4, *([] if {"--episodes"} & {*map(str, options)} else ALONE)]
        named = ["--trust", trust or self.template]
        return ["distill", "policy", source or self.pruned.path, "-o", self.out, *named, *short, *options]

    def copied(self, file: str = "", content: bytes | None = None, *, sealed: bool = False) -> Path:
        """A copy of the pruned bundle with a file rewritten, or removed; ``sealed`` again, the hashes are right."""
        path = Path(shutil.copytree(self.pruned.path, self.root / "damaged"))
        if file and content is None:
            (path / file).unlink()
        elif file and content is not None:
            (path / file).write_bytes(content)
        if sealed:
            seal(path, self.pruned.manifest)
        return path

    def recorded(self, **changes: Any) -> Line:
        """Distil where the recording has arrays changed, or left out (None)."""
        arrays = observations(8, seed=1) | changes
        np.savez(self.root / "recording.npz", **{name: values for name, values in arrays.items() if values is not None})
        return self.line(
            source=self.copied("data/calibration.npz", (self.root / "recording.npz").read_bytes(), sealed=True)
        )

    def policy(self, *swaps: tuple[str, str, str], drop: tuple[str, ...] = ()) -> Path:
        """The tiny policy with texts swapped in its files: (file, old, new)."""
        folder = Path(shutil.copytree(self.template, self.root / "changed"))
        for file, old, new in swaps:
            text = (folder / file).read_text()
            assert old in text, f"{old} is not in {file}"
            (folder / file).write_text(text.replace(old, new))
        for file in drop:
            (folder / file).unlink()
        return folder

    def source(self, *swaps: tuple[str, str, str], drop: tuple[str, ...] = ()) -> Path:
        """The bundle of a changed policy, as its factory makes it."""
        policy = TorchModule(policy=self.policy(*swaps, drop=drop))
        return run_transform(policy, None, self.root / "source", Context()).bundle.path

    def unmade(self) -> Path:
        """A description that names no code."""
        folder = self.root / "unmade"
        folder.mkdir()
        lines = (self.template / "policy.yaml").read_text().splitlines(keepends=True)
        (folder / "policy.yaml").write_text("".join(line for line in lines if not line.startswith("source:")))
        return folder

    def teacher(self, *swaps: tuple[str, str, str], drop: tuple[str, ...] = ()) -> Line:
        return self.line("--teacher", self.source(*swaps, drop=drop), "--trust", self.root / "changed")

    def student(self, *swaps: tuple[str, str, str], drop: tuple[str, ...] = (), options: Line = ALONE) -> Line:
        """Distil a changed policy after it was pruned."""
        source = Bundle.open(self.source(*swaps, drop=drop))
        pruned = run_transform(Neurons(ratio=0.7), source, self.root / "pruned", Context()).bundle
        return self.line(*options, source=pruned.path, trust=self.root / "changed")

    def code(self, new: str, old: str = FORWARD) -> Line:
        return self.student(("policy.py", old, new))

    def world(self, old: str, new: str) -> Line:
        """Play in a changed environment."""
        return self.student(("environment.py", old, new), options=PLAYED)

    def changed_since(self) -> Line:
        line = self.student()
        with (self.root / "changed/policy.py").open("a") as stream:
            stream.write("\nWIDTH = 16\n")
        return line

    def unwritable(self, function: str) -> Line:
        """The disk is full whenever that function is called."""

        def full(*_: object, **__: object) -> None:
            raise OSError(28, "No space left on device")

        self.patch.setattr(function, full)
        return self.line()

    def exists(self) -> Line:
        self.taken()
        return self.line()

    def cache_is_a_file(self) -> Line:
        self.patch.setenv("VLATOOL_CACHE", str(self.file("file", "a file")))
        return self.line()

    def no_tensorboard(self) -> Line:
        self.patch.delitem(sys.modules, "torch.utils.tensorboard", raising=False)
        self.patch.setitem(sys.modules, "tensorboard", None)
        return self.line("--events", self.place / "events")


def option(says: str, *words: Any, code: int = 3) -> Row:
    return Row(" ".join(map(str, words)), says, code, lambda at: at.line(*words))


def nan(values: Any) -> Any:
    values = values.copy()
    values[1].flat[0] = np.nan
    return values


ROWS = [
    option("steps = 0", "--steps", 0),
    option("valid integer", "--steps", "many", code=2),
    option("No such option", "--step-size", 1, code=2),
    option("batch = 0", "--batch", 0),
    option("learning_rate = 0", "--learning-rate", 0),
    option("learning_rate = nan", "--learning-rate", "nan"),
    option("learning_rate = inf", "--learning-rate", "inf"),
    option("weight_decay = -1", "--weight-decay", -1),
    option("average = 1", "--average", 1),
    option("episodes = -1", "--episodes", -1),
    option("student_episodes = -1", "--episodes", 0, "--student-episodes", -1),
    option("every = 0", "--every", 0),
    option("noise = 2", "--noise", 2),
    option("threads = -1", "--threads", -1),
    option("processes = 0", "--processes", 0),
    option("accumulate = 0", "--accumulate", 0),
    option("patience = -1", "--patience", -1),
    option("temperature = 0", "--temperature", 0),
    option("delta = 0", "--delta", 0),
    option("from_batches = -1", "--from-batches", -1),
    option("add training: train.py:batches to it", "--from-batches", 5),
    option("features = -1", "--features", -1),
    option("attention = nan", "--attention", "nan"),
    option("have no stack of blocks in common", "--features", 1),
    option("--features and --attention would compare nothing", "--features", 1, "--attention", 2),
    option("'fp8' is not one of", "--precision", "fp8", code=2),
    option("did you mean 'huber'", "--loss", "hubert"),
    option("kl compares discrete actions", "--loss", "kl"),
    option("A batch of 4 cannot be split into 5 parts", "--accumulate", 5),
    option("A batch of 4 cannot be split into 6 parts", "--accumulate", 2, "--processes", 3),
    option("evaluations begin at 5000000", "--first-seed", 4_999_999, "--episodes", 10),
    option("such as depth=0.5,width=0.75", "--student", "half"),
    option("knows no 'dept'; did you mean 'depth'", "--student", "dept=0.5"),
    option("depth=0: what stays is a share above 0, at most 1", "--student", "depth=0"),
    option("takes nothing away", "--student", "depth=1,width=1"),
    option("has no stack of blocks", "--student", "depth=0.5"),
    option("multiply-accumulates can go", "--student", "width=0.01", code=5),
    option("alpha = 1.5", "--alpha", 1.5),
    option("alpha = nan", "--alpha", "nan"),
    option("label_share = 0", "--label-share", 0),
    option("uses none of them", "--label-share", 0.5),
    option("'shuffle' is not one of", "--control", "shuffle", code=2),
    option("it is not asked", "--control", "noise", "--alpha", 0),
    option("--features would let the teacher say what it knows; --alpha 0", "--alpha", 0, "--features", 1),
    option("say what it knows; --control noise", "--control", "noise", "--attention", 0.5),
    option("got --from-batches 8", "--alpha", 0, "--from-batches", 8),
    option("got --episodes 2", "--alpha", 0, "--episodes", 2),
    Row("an output that exists", "exists", 3, Workshop.exists),
    Row("events into a file", "is a file; events are written into a directory", 3,
        lambda at: at.line("--events", at.file("file", "a file"))),
    Row("events into the output", "is in the output", 2, lambda at: at.line("--events", at.out / "events")),
    Row("events without tensorboard", "pip install 'vlatool[tensorboard]'", 4, Workshop.no_tensorboard),
    Row("a cache that is a file", "Not a directory", 3, Workshop.cache_is_a_file),
    Row("a full disk at the checkpoint", "No space left on device", 3,
        lambda at: at.unwritable("vlatool.training.loop.Trainer.save")),
    Row("a full disk at the recordings", "No space left on device", 3,
        lambda at: at.unwritable("vlatool.training.rounds.new_array")),
    Row("a full disk at the labels", "No space left on device", 3,
        lambda at: at.unwritable("vlatool.training.session.write_labels")),
    Row("a full disk at the bundle", "the disk is full", 3,
        lambda at: at.unwritable("vlatool.module.stage.write_module")),
    Row("a full disk at the report", "the disk is full", 3,
        lambda at: at.unwritable("vlatool.training.report.write_reports")),
    # ---- the teacher
    Row("no such teacher", "No bundle at", 3, lambda at: at.line("--teacher", at.root / "none")),
    Row("a teacher that is no bundle", "is not a bundle", 3, lambda at: at.line("--teacher", at.place)),
    Row("a teacher that is a policy without a factory", "names no factory", 3,
        lambda at: at.line("--teacher", at.unmade())),
    Row("a processor asked to be a GPU", "this torch finds no GPU", 3, lambda at: at.line("--device", "cuda")),
    Row("the student as its teacher", "is the student itself", 3, lambda at: at.line("--teacher", at.pruned.path)),
    Row("a damaged teacher", "has 1 bytes; the manifest says", 3,
        lambda at: at.line("--teacher", at.copied("module/main.safetensors", b"0"))),
    Row("a teacher with other labels", "gives 'action' as tensor ... of dy, dx", 3,
        lambda at: at.teacher(("policy.yaml", "[dx, dy]", "[dy, dx]"))),
    Row("a teacher with another chunk", "gives 'action' as tensor [1, 2, 2]", 3, lambda at: at.teacher(
        ("policy.yaml", "shape: [1, 4, 2]", "shape: [1, 2, 2]"), ("policy.yaml", "chunk: 4", "chunk: 2"),
        ("policy.py", "reshape(1, 4, 2)", "reshape(1, 4, 2)[:, :2]"), drop=RECORDINGS)),
    Row("a teacher of another action size", "gives 'action' as tensor [1, 4, 3]", 3, lambda at: at.teacher(
        ("policy.yaml", "shape: [1, 4, 2], unit: [m, m], labels: [dx, dy]",
         "shape: [1, 4, 3], unit: [m, m, m], labels: [dx, dy, dz]"),
        ("statistics.json", "[0.05, 0.1]", "[0.05, 0.1, 1.0]"),
        ("statistics.json", "[0.01, -0.02]", "[0.01, -0.02, 0]"), ("policy.py", FORWARD, WIDER), drop=RECORDINGS)),
    Row("a teacher with another vocabulary", "have another vocabulary for 'instruction'", 3,
        lambda at: at.teacher(("vocabulary.json", '"red": 5, "blue": 6', '"red": 6, "blue": 5'))),
    Row("a teacher with other statistics of its input", "have another normalisation for 'proprio'", 3,
        lambda at: at.teacher(("statistics.json", "[0.1, -0.2, 0.5]", "[0.1, -0.2, 0.6]"))),
    Row("a teacher with other statistics of its action", "have another normalisation for 'action'", 3,
        lambda at: at.teacher(("statistics.json", "[0.05, 0.1]", "[0.05, 0.2]"))),
    Row("a teacher that acts in another way", "have another unit, mode, parts or conversions for 'action'", 3,
        lambda at: at.teacher(("policy.yaml", "mode: delta", "mode: absolute"))),
    Row("a teacher without one of the inputs", "is given 'proprio' as nothing", 3, lambda at: at.teacher(
        ("policy.yaml", "- {name: proprio,", "- {name: state,"), drop=RECORDINGS)),
    Row("a teacher whose action is not finite", "The teacher gives an action that is not finite", 3,
        lambda at: at.code(WHOLE_FAILS)),
    # ---- the student
    Row("no such student", "neither a bundle nor a policy source", 3, lambda at: at.line(source=at.root / "none")),
    Row("a student that is damaged", "has 1 bytes; the manifest says", 3,
        lambda at: at.line(source=at.copied("module/main.safetensors", b"0"))),
    Row("a student without its weights", "lacks the file", 3,
        lambda at: at.line(source=at.copied("module/main.safetensors"))),
    Row("weights that are no safetensors", "cannot be read as safetensors", 3,
        lambda at: at.line(source=at.copied("module/main.safetensors", b"0", sealed=True))),
    Row("a policy that was not changed", "would be its own teacher", 3,
        lambda at: at.line(source=at.source(), trust=at.root / "changed")),
    Row("code that changed since", "changed", 3, Workshop.changed_since),
    Row("no gradient", "gives its action without gradients", 3, lambda at: at.code(
        "    @torch.no_grad()\n    def forward(", "    def forward(")),
    Row("a policy that fails in training", "ValueError: not like this", 3, lambda at: at.code(
        "        if torch.is_grad_enabled():\n            raise ValueError('not like this')\n" + FORWARD)),
    Row("a policy that leaves in training", "called sys.exit", 3, lambda at: at.code(
        "        if torch.is_grad_enabled():\n            raise SystemExit(0)\n" + FORWARD)),
    Row("a loss that is not finite", "The loss is nan in step 1 of 3", 3, lambda at: at.code(
        "        lost = float('nan') if torch.is_grad_enabled() else 0\n" + FORWARD.replace("\n", " + lost\n"))),
    Row("a loss that is not finite, in two processes", "The loss is nan in step 1 of 3", 3, lambda at: [*at.code(
        "        lost = float('nan') if torch.is_grad_enabled() else 0\n" + FORWARD.replace("\n", " + lost\n")),
        "--processes", 2]),
    Row("a learning rate that is too high", "try a lower --learning-rate", 3, lambda at: [*at.code(EXPLODING),
        "--learning-rate", 1, "--steps", 40]),
    # ---- recordings
    Row("a recording with NaN", "'proprio' in ... is not finite in 1 of 8 samples", 3,
        lambda at: at.recorded(proprio=nan(observations(8, seed=1)["proprio"]))),
    Row("a recording without an input", "has no 'proprio'", 3, lambda at: at.recorded(proprio=None)),
    Row("a recording of another shape", "has the shape", 3,
        lambda at: at.recorded(proprio=np.zeros((8, 4), np.float32))),
    Row("a recording of another type", "takes uint8", 3,
        lambda at: at.recorded(image=np.zeros((8, 8, 8, 3), np.float32))),
    Row("an empty recording", "holds no samples", 3,
        lambda at: at.recorded(**{name: values[:0] for name, values in observations(8, seed=1).items()})),
    Row("a recording of different lengths", "different numbers of samples", 3,
        lambda at: at.recorded(proprio=np.zeros((7, 3), np.float32))),
    Row("a recording that is none", "npz", 3,
        lambda at: at.line(source=at.copied("data/calibration.npz", b"nothing", sealed=True))),
    Row("nothing to learn from", "no observations to train on", 3,
        lambda at: at.student(drop=RECORDINGS)),
    Row("nothing to judge with", "--patience needs something to judge with", 3, lambda at: at.student(
        drop=RECORDINGS, options=[*ALONE, "--patience", 1])),
    Row("an expert without a recording", "needs an expert's actions, and ... has no recording", 3,
        lambda at: at.student(drop=RECORDINGS, options=[*ALONE, "--alpha", 0.5])),
    Row("an expert without actions", "A loss against an expert's actions needs them, and ... has none", 3,
        lambda at: [*at.recorded(action=None), "--alpha", 0.5]),
    Row("a control of one observation", "said of another one; there is 1", 3, lambda at: [*at.recorded(
        **{name: values[:1] for name, values in observations(8, seed=1).items()}), "--control", "noise"]),
    # ---- the environment
    Row("an environment that raises in reset", "failed at seed 1000000: ValueError: no world", 3,
        lambda at: at.world("        self.seed, self.steps = seed, 0\n", "        raise ValueError('no world')\n")),
    Row("an environment that raises in step", "failed at seed 1000000: KeyError", 3,
        lambda at: at.world("        self.steps += 1\n", "        raise KeyError('gone')\n")),
    Row("an observation of another shape", "gives what the policy does not take", 3,
        lambda at: at.world("(8, 8, 3), np.uint8)", "(9, 9, 3), np.uint8)")),
    Row("an observation that is not finite", "gives what the policy does not take", 3,
        lambda at: at.world("self.position.copy()", "self.position * np.nan")),
    Row("an environment that leaves", "called sys.exit", 3,
        lambda at: at.world("        self.steps += 1\n", "        raise SystemExit(0)\n")),
    Row("an environment that ends the process", "ended its process with exit code 7", 3,
        lambda at: at.world("        self.steps += 1\n", "        import os\n        os._exit(7)\n")),
    Row("an environment without success", "success", 3,
        lambda at: at.world('{"success": done and good}', "{}")),
]  # fmt: skip


def place(root: Path, monkeypatch: pytest.MonkeyPatch, fixture: Callable[[str], Any]) -> Workshop:
    """Return where they are made."""
    monkeypatch.setenv("VLATOOL_CACHE", str(root / "cache"))
    monkeypatch.setattr("vlatool.stage.run.run_in_child", lambda stage, *rest: stage.run(*rest))
    return Workshop(root, fixture("policy_template"), fixture("pruned_once"), monkeypatch)
