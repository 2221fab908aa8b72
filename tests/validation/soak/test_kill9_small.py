"""A kill of ``quantize``, three in the full form; ``tests/validation/soak/kill9.py`` makes as many as are wanted."""

from _full import small_or_full
from kill9 import Work, contents, differences, drafts, soak


def test_a_killed_quantize_leaves_nothing_or_all_and_runs_again_to_the_same_bytes(float_bundle, tmp_path):
    work, kills = Work(["quantize", str(float_bundle.path)], tmp_path), small_or_full(1, 3)
    assert soak(work, kills=kills, seed=1, tell=lambda _line: None) == []
    assert work.counts["killed"] + work.counts["ended before the kill"] == kills
    assert work.counts["output absent"] + work.counts["output whole"] == kills


def test_the_soak_sees_a_half_bundle_a_difference_and_a_draft(int8_bundle, copied, tmp_path):
    work = Work(["quantize"], tmp_path)
    work.reference = int8_bundle.path
    copied(int8_bundle).path.rename(tmp_path / "whole")
    work.place.mkdir()
    (tmp_path / "whole").rename(work.out)
    assert work.look() == work.look_at_the_end() == []
    graph = work.out / "graphs/main.onnx"
    graph.write_bytes(graph.read_bytes()[:-1])
    (work.place / ".out.tmp-1-a").mkdir()
    assert "half a bundle" in work.look()[0]
    assert differences(int8_bundle.path, work.out) == ["differs from the reference: graphs/main.onnx"]
    assert drafts(tmp_path) == [work.place / ".out.tmp-1-a"]
    assert work.look_at_the_end()[-1].startswith("left over: ")
    assert "reports/report.json" not in contents(work.out)
