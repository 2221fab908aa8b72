"""What a spec may say of an image, what it may not, and in which version of the manifest it stands."""

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from vlatool.bundle.image import Image, ImageStep
from vlatool.bundle.manifest import Manifest
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import BundleError, SpecError

ACT = {"range": [0, 1], "mean": [0.485, 0.456, 0.406], "std": [0.229, 0.224, 0.225]}
PADDED = {"steps": [{"op": "resize", "size": [224, 224], "fit": "contain"}, {"op": "pad", "size": [224, 224]}]}


def tensor(image: Any, shape: list[Any] | None = None, dtype: str = "float32", **more: Any) -> TensorSpec:
    return TensorSpec.from_dict({"name": "top", "shape": shape or [1, 3, 224, 224], "dtype": dtype, "image": image,
                                 **more})  # fmt: skip


def spec_of(image: Any) -> dict[str, Any]:
    given = {"name": "top", "shape": [1, 3, 224, 224], **({} if image is None else {"image": image})}
    return {"inputs": [given], "outputs": [{"name": "action", "shape": [1, 1, 2]}], "control_hz": 10}


@pytest.mark.parametrize(
    "image",
    [
        {**PADDED, "frame": "bgr", "range": [-1, 1]},
        {"like": "opencv", "steps": [{"op": "crop", "box": [0, 80, 480, 480]}, {"op": "resize", "size": [224, 224]}]},
        {"like": "torch", "steps": [{"op": "resize", "size": [224, 224], "antialias": True, "filter": "bicubic"}]},
        {"camera": [224, 224], **ACT},
    ],
)
def test_an_image_is_read_back_as_it_was_written(image: dict[str, Any]):
    spec = PolicySpec.from_dict(spec_of(image))
    assert PolicySpec.from_dict(spec.to_dict()) == spec
    written = spec.to_dict()["inputs"][0]["image"]
    assert Image.from_dict(written) == spec.inputs[0].image
    assert set(written) == set(image)


def test_a_manifest_with_an_image_is_of_the_second_version_and_any_other_of_the_first():
    with_image = Manifest("p", "1", PolicySpec.from_dict(spec_of(PADDED))).to_dict()
    without = Manifest("p", "1", PolicySpec.from_dict(spec_of(None))).to_dict()
    assert (with_image["schema"], without["schema"]) == (2, 1)
    assert Manifest.from_dict(with_image).to_dict() == with_image
    assert Manifest.from_dict(without).to_dict() == without
    with pytest.raises(BundleError, match="schema 1, but what begins with 2, such as 'image'"):
        Manifest.from_dict({**with_image, "schema": 1})
    with pytest.raises(BundleError, match="schema 4; this vlatool reads up to 3"):
        Manifest.from_dict({**with_image, "schema": 4})


@pytest.mark.parametrize(
    ("image", "words"),
    [
        ("rgb", "'image' must be a mapping"),
        ({"frames": "rgb"}, "unknown key 'frames'.*did you mean 'frame'"),
        ({"frame": "gbr"}, "frame 'gbr'"),
        ({"like": "tf"}, "like 'tf'"),
        ({"layout": "hw"}, "layout hw for rgb"),
        ({"channels": "rgba"}, "rgba of rgb frames"),
        ({"range": [1, 0]}, "must be the lower"),
        ({"range": [0]}, "range of 'image' has 1 number;"),
        ({"mean": [0.5, 0.5]}, "mean of 'image' has 2 numbers"),
        ({"std": [1, 0, 1]}, "above 0"),
        ({"std": [1, float("nan"), 1]}, "must be a number"),
        ({"camera": [0, 640]}, "whole number from 1"),
        ({"camera": [480]}, "wanted 2 numbers"),
        ({"steps": {"op": "crop"}}, "must be a list"),
        ({"steps": ["crop"]}, "must be a mapping"),
        ({"steps": [{"size": [224, 224]}]}, "needs 'op'"),
        ({"steps": [{"op": "zoom", "size": [224, 224]}]}, "op 'zoom'"),
        ({"steps": [{"op": "resize", "size": [224, 224], "mode": "linear"}]}, "unknown key 'mode'"),
        ({"steps": [{"op": "resize", "size": [224, 224], "filter": "linear"}]}, "filter 'linear'"),
        ({"steps": [{"op": "resize", "size": [224]}]}, "wanted 2 numbers"),
        ({"steps": [{"op": "resize", "size": [224, -1]}]}, "whole number from 1"),
        ({"steps": [{"op": "resize", "size": [224, True]}]}, "whole number from 1"),
        ({"steps": [{"op": "resize", "size": [10**6, 10**6]}]}, "limit 'elements'"),
        ({"steps": [{"op": "resize", "size": [224, 224], "antialias": "yes"}]}, "true or false"),
        ({"steps": [{"op": "resize"}]}, "needs 'size'"),
        ({"steps": [{"op": "crop", "size": [224, 224], "box": [0, 0, 224, 224]}]}, "either 'size' or 'box'"),
        ({"steps": [{"op": "crop", "size": [224, 224], "fit": "cover"}]}, "'fit', which belongs to another"),
        ({"steps": [{"op": "pad", "size": [640, 640], "value": [256]}]}, "0 to 255"),
        ({"steps": [{"op": "pad", "size": [640, 640], "value": [0.5]}]}, "whole numbers"),
        ({"steps": [{"op": "pad", "size": [640, 640], "value": [0, 0, 0, 0]}]}, "pads rgb with 4 numbers"),
        ({"like": "torch", "steps": [{"op": "resize", "size": [224, 224], "filter": "lanczos"}]}, "PIL's alone"),
        ({"like": "opencv", "steps": [{"op": "resize", "size": [224, 224], "antialias": True}]}, "has none"),
        ({"steps": [{"op": "resize", "size": [224, 224]}] * 17}, "up to 16"),
        ({"steps": [{"op": "resize", "size": [200, 224]}]}, r"makes 200x224 of a frame of 480x640"),
        ({"steps": [{"op": "crop", "size": [500, 500]}]}, "of a frame of 480x640 nothing can be made: step 1"),
        ({"camera": [480, 640]}, "makes 480x640 of a frame of 480x640"),
        ({"channels": "grey"}, "3 channels in its shape"),
    ],
)
def test_an_impossible_image_is_refused_with_the_reason(image: Any, words: str):
    with pytest.raises(SpecError, match=words):
        tensor(image)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"dtype": "uint8", "image": ACT}, "float32, float16, and uint8"),
        ({"dtype": "int64", "image": {}}, "float32, float16, and uint8"),
        ({"dtype": "uint8", "image": {"like": "torch"}}, "float32, float16, and uint8"),
        ({"shape": [2, 3, 224, 224], "image": {}}, "only axes of 1"),
        ({"shape": [3, 224], "image": {}}, "has 3 axes"),
        ({"image": {}, "normalisation": "mean_std", "statistics": "s.json#x"}, "a mean and std of its own"),
        ({"image": {}, "finite": False}, "a mean and std of its own"),
        ({"image": {"layout": "hwc"}}, "layout hwc"),
    ],
)
def test_an_input_that_no_image_can_be_is_refused(more: dict[str, Any], words: str):
    with pytest.raises(SpecError, match=words):
        TensorSpec.from_dict({"name": "top", "shape": [1, 3, 224, 224], "dtype": "float32", **more})


def test_the_examples_of_the_guide_are_inputs():
    text = (Path(__file__).parents[2] / "docs/guides/your-own-policy.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```yaml\n(- name: .*?)```", text, re.DOTALL)
    inputs = [TensorSpec.from_dict(entry) for block in blocks for entry in yaml.safe_load(block)]
    assert [each.observation.shape for each in inputs] == [(1, 480, 640, 3)] * 2


def test_an_output_is_no_image():
    given = {"name": "action", "shape": [1, 3, 8, 8], "image": {}}
    with pytest.raises(SpecError, match="only a frame of a camera"):
        PolicySpec.from_dict({"inputs": [{"name": "x", "shape": [1, 1]}], "outputs": [given], "control_hz": 1})


@pytest.mark.parametrize(
    ("image", "shape", "frame"),
    [
        (PADDED, [1, 3, 224, 224], (480, 640, 3)),
        ({**PADDED, "frame": "bgra", "camera": [720, 1280]}, [1, 3, 224, 224], (720, 1280, 4)),
        ({"frame": "grey"}, [1, 1, 3, 96, 128], (96, 128)),
        ({"channels": "grey", "layout": "hw"}, [480, 640], (480, 640, 3)),
        ({}, [3, "height", "width"], (480, 640, 3)),
        ({"steps": [{"op": "crop", "size": [600, 600]}], "camera": [600, 800]}, [1, 3, 600, 600], (600, 800, 3)),
    ],
)
def test_an_observation_has_a_frame_of_the_camera(image: Any, shape: list[Any], frame: tuple[int, ...]):
    observed = tensor(image, shape).observation
    assert (observed.shape, observed.dtype, observed.image) == ((1, *frame), "uint8", None)


@pytest.mark.parametrize(
    ("fit", "before", "after"),
    [
        ("contain", (480, 640), (168, 224)),
        ("contain", (2, 1920), (1, 224)),
        ("contain", (100, 70), (224, 156)),
        ("cover", (480, 640), (224, 298)),
        ("cover", (640, 480), (298, 224)),
        ("cover", (100, 100), (224, 224)),
        ("fill", (1, 1), (224, 224)),
    ],
)
def test_a_resize_keeps_the_aspect_where_it_is_said(fit: str, before: tuple[int, int], after: tuple[int, int]):
    assert ImageStep("resize", (224, 224), fit=fit).size_after(before, "pil") == after
