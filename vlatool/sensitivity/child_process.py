"""Measure the sensitivities in a child process, since the graphs with switches have never run before."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.data import recorded_observations
from vlatool.files.messages import from_json, to_json
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.sensitivity.layers import LayerError, sensitivities
from vlatool.stage.base import Context
from vlatool.user_code import children

PRELOAD = ("numpy", "onnx", "onnxruntime", __name__)


def sensitivities_in_child(
    bundle: Bundle, stage: StaticInt8, recorded: int, samples: int, context: Context, seconds: float
) -> list[LayerError]:
    """Return the result of ``sensitivities``.

    Args:
        bundle: A float32 bundle with a recording.
        recorded: Number of observations of that recording to choose from.
        samples: Number of observations to measure on, spread over these.

    Raises:
        VlatoolError: errors of ``sensitivities``; GraphError when the engine crashes the child.
    """
    job = {
        "bundle": str(bundle.path.absolute()), "options": stage.explicit_options(), "recorded": recorded,
        "samples": samples, "seconds": seconds,
    }  # fmt: skip
    reply = children.call(f"{__name__}:run", job, context.progress, "measuring the layers", PRELOAD, own=True)
    return from_json(list[LayerError], json.loads(reply), "layers")


def run(job: Mapping[str, Any], tell: children.OnProgress) -> str:
    """Measure the layers of a job in this process; return them as JSON, with possible infinities and NaN."""
    bundle = Bundle.open(Path(job["bundle"]), verify=False)
    observations, limit = recorded_observations(bundle, job["recorded"]), job["samples"]
    selected = observations[:: max(1, len(observations) // limit)][:limit]
    stage = StaticInt8(**job["options"])
    layers = sensitivities(bundle, stage, None, selected, Context(tell), seconds=job["seconds"])
    return json.dumps(to_json(layers))
