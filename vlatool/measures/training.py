"""What a training took."""

from __future__ import annotations

from vlatool.measures import Family, Quantity

TRAINING_TIME = Family(Quantity("training_time.{stage}", "s", "training time, {stage}"))
