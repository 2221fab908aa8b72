"""What of a bundle is sent to workers on other machines."""

from __future__ import annotations

from dataclasses import replace

import pytest

from vlatool.bundle.bundle import Bundle
from vlatool.episodes.jobs import _work
from vlatool.episodes.play import EpisodesJob

JOB = EpisodesJob("environment.py:make", ".", "reach", (1, 2))


@pytest.mark.parametrize(
    ("changes", "sent"),
    [({}, False), ({"control": "random"}, True), ({"control": "constant"}, True), ({"noise": 0.1}, True)],
)
def test_recordings_go_along_where_actions_are_drawn_from_them(float_bundle: Bundle, changes: dict, sent: bool):
    assert "data/calibration.npz" in float_bundle.manifest.files
    names = _work("play", float_bundle, [JOB, replace(JOB, **changes)], "", away=True).folders[0].names
    assert ("data/calibration.npz" in names) is sent
    assert "data/evaluation.npz" not in names
    assert {graph.file for graph in float_bundle.manifest.graphs.values()} <= set(names)
