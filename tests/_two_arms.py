"""Two arms of one joint each, whose distance is easy to say."""

from __future__ import annotations

from vlatool.runtime.kinematics import Capsule, Chain, Clearance, Link, Pose


def two_arms() -> Clearance:
    """Two arms of one joint, 1 m apart, each a bar of 0.4 m that turns in the plane."""
    bar = (Capsule(0, (0.0, 0.0, 0.0), (0.4, 0.0, 0.0), 0.05), Capsule(-1, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.1))
    left = Chain((Link("turn", (0.0, 0.0, 0.0)),))
    right = Chain(left.links, base=Pose((1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
    return Clearance((left, right), ([0], [1]), (bar, bar))
