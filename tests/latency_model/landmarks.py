"""Well-known policies and models on well-known boards: predicted beside published, each model left out of the fit.

    python tests/latency_model/landmarks.py POINTS.csv     # points as `vlatool hwselect score` takes them

Also predicts tests/latency_model/unseen.csv, a device and two models that no point of the fit is about.
"""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Sequence
from pathlib import Path

from vlatool.latency_model.features import rows_of
from vlatool.latency_model.fit import split_by_part
from vlatool.latency_model.folds import Sample
from vlatool.latency_model.model import LatencyModel, TrainingData, load_model
from vlatool.latency_model.published_latencies import Point, merge_versions, read_points
from vlatool.latency_model.score import score_points, summary_lines

UNSEEN = Path(__file__).with_name("unseen.csv")
LANDMARKS = (
    ("OpenVLA-7B, whole inference", "OpenVLA", "jetson-agx-orin-64gb", ""),
    ("GR00T N1.7, backbone and action head", "GR00T-N1.7-3B", "jetson-agx-orin-64gb", ""),
    ("Llama-2-7B, one token", "llama-2-7b", "core-ultra-7-165h", ""),
    ("Llama-3.2-3B, one token", "Llama-3.2-3B", "jetson-orin-nano", ""),
    ("Llama-3.1-8B, Qwen2.5-7B, one token", "Llama-3.1-8B|Qwen2.5-7B", "jetson-orin-nano", "unseen"),
    ("YOLO11n", "yolo11n", "raspberry-pi-5", "unseen"),
    ("YOLO11n", "yolo11n", "jetson-orin-nano-8gb-super", "unseen"),
)
"""Title, beginning of the model's name (a regular expression), beginning of the device's name, file."""


def main() -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("points", type=Path, help="published latencies")
    known = read_points(parser.parse_args().points)
    fresh = read_points(UNSEEN)
    print(f"{'':38}{'device':27}{'runtime':17}{'dtype':9}{'published':>10}{'predicted':>11}  80 % interval")
    for title, name, device, file in LANDMARKS:
        rest = merge_versions([point for point in known if not about(name, point)])
        model = fitted(rest, load_model())
        asked = [
            point for point in (fresh if file else known)
            if about(name, point) and point.question and point.question.compute_unit.device.startswith(device)
        ]  # fmt: skip
        answers = model.predict([point.question for point in asked if point.question])
        for point, answer in zip(asked, answers, strict=True):
            print(line(title, point, answer.ms, answer.low, answer.high, answer.why))
    print()
    for text in summary_lines(score_points(UNSEEN)):
        print(text)
    return 0


def about(name: str, point: Point) -> bool:
    """Say whether a figure is of a model, by the beginning of its name (a regular expression)."""
    return point.question is not None and re.match(name, point.question.work.name) is not None


def line(title: str, point: Point, ms: float, low: float, high: float, why: str) -> str:
    """Return one line of the table."""
    published = math.exp(point.log_ms)
    question = point.question
    runtime, dtype = (question.runtime, question.precision) if question else ("", "")
    told = why or f"{low:.3g}-{high:.3g} {'inside' if low <= published <= high else 'OUTSIDE'}"
    device = question.compute_unit.device if question else ""
    return f"{title:38}{device:27}{runtime:17}{dtype:9}{published:>10.4g}{ms:>11.4g}  {told}"


def fitted(points: Sequence[Point], like: LatencyModel) -> LatencyModel:
    """Return the model with the scales of another one, given these points."""
    parts: dict[str, TrainingData] = {}
    for part, mine in split_by_part(points).items():
        if not mine:
            continue
        sample = Sample.from_points(mine)
        parts[part] = TrainingData(rows_of(sample.questions, like.shares[part]), sample.logs, like.parts[part].scales)
    return LatencyModel(parts, like.shares, like.conformal, like.about)


if __name__ == "__main__":
    raise SystemExit(main())
