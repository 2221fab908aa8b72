"""The directory of a sample: description, vocabulary, recorded observations."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from vlatool import registry
from vlatool.bundle.spec import PolicySpec
from vlatool.errors import UsageError
from vlatool.samples._words import LONGEST, instructions, vocabulary
from vlatool.samples._write import smooth_image, write_sample


@pytest.mark.parametrize("name", registry.names("samples"))
def test_the_description_says_what_the_module_says(name: str, tmp_path: Path) -> None:
    module = registry.module("samples", name)
    write_sample(name.replace("_", "-"), tmp_path, seed=5)
    content = yaml.safe_load((tmp_path / "policy.yaml").read_text(encoding="utf-8"))
    assert content["name"] == name.replace("_", "-")
    assert content["source"] == f"vlatool.samples.{name}:make"
    assert content["arguments"] == {"seed": 5}
    assert content["spec"] == module.SPEC
    assert content.get("program") == getattr(module, "PROGRAM", None)
    spec = PolicySpec.from_dict(content["spec"])
    assert (tmp_path / "vocabulary.json").exists() == any(tensor.kind == "text" for tensor in spec.inputs)
    for part, count in (("calibration", 48), ("evaluation", 12)):
        with np.load(tmp_path / f"{part}.npz", allow_pickle=False) as data:
            assert set(data.files) == {tensor.name for tensor in spec.inputs}
            for tensor in spec.inputs:
                values = data[tensor.name]
                if tensor.kind == "text":
                    assert values.dtype.kind == "U"
                    assert values.shape == (count,)
                else:
                    assert values.shape == (count, *tensor.shape[1:])
                    assert values.dtype == tensor.dtype


def test_writing_twice_gives_the_same_bytes_and_another_seed_others(tmp_path: Path) -> None:
    for folder, seed in (("a", 0), ("b", 0), ("c", 1)):
        (tmp_path / folder).mkdir()
        write_sample("vla-45m", tmp_path / folder, seed)
    for name in ("policy.yaml", "vocabulary.json", "calibration.npz", "evaluation.npz"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert (tmp_path / "a" / "calibration.npz").read_bytes() != (tmp_path / "c" / "calibration.npz").read_bytes()


def test_calibration_and_evaluation_differ(tmp_path: Path) -> None:
    write_sample("action-expert", tmp_path)
    with np.load(tmp_path / "calibration.npz") as seen, np.load(tmp_path / "evaluation.npz") as fresh:
        assert not np.array_equal(seen["context"][: len(fresh["context"])], fresh["context"])
        assert ((seen["time"] >= 0.1) & (seen["time"] <= 1.0)).all()


def test_an_unknown_sample_is_named_with_its_neighbour(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="vit_s"):
        write_sample("vit-x", tmp_path)


def test_instructions_are_made_of_vocabulary_words_and_fit_the_narrowest_policy() -> None:
    content = json.loads(json.dumps(vocabulary()))
    words = content["words"]
    assert 250 < len(words) < 1000
    assert sorted(words.values()) == list(range(2, len(words) + 2))
    for text in instructions(500, np.random.default_rng(0)):
        assert set(text.split()) <= set(words)
        assert 3 <= len(text.split()) <= LONGEST
        assert text == text.lower()


def test_images_are_smooth_and_use_the_range() -> None:
    image = smooth_image(64, 96, np.random.default_rng(0)).astype(float)
    assert image.shape == (64, 96, 3)
    assert image.std() > 30
    assert np.abs(np.diff(image, axis=0)).mean() < 0.25 * image.std()
