"""Two bundles of one policy in an evaluation: how they are called, whose progress is told, and when one is refused."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from tests._reach import EAGER, GOOD, bundle_of
from vlatool.bundle.bundle import Bundle, seal
from vlatool.errors import GraphError
from vlatool.evaluate._names import names_of
from vlatool.evaluate.closed_loop import ClosedLoop
from vlatool.files.npz import open_npz
from vlatool.render.document import Table
from vlatool.render.sections.variants import Variants
from vlatool.report import Measurement, Report, Row
from vlatool.stage.base import Context
from vlatool.stage.finish import GOLDEN, save_npz


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two bundles beside each other, ``float32`` and ``int8``, and the ``policy`` of both."""
    folder = tmp_path_factory.mktemp("variants")
    for name, kind in (("float32", GOOD), ("int8", EAGER)):
        shutil.move(bundle_of(folder / f"{name}-made", kind).path, folder / name)
    return folder


def loop(folder: Path, **options: object) -> ClosedLoop:
    return ClosedLoop(policy=folder / "float32-made" / "policy", episodes=2, **options)


@pytest.fixture(scope="module")
def told(folder: Path) -> tuple[Report, list[str]]:
    """A report, and what was told meanwhile."""
    said: list[str] = []
    stage = loop(folder, baseline=folder / "float32", disturb=("delay",))
    return stage.run(Bundle.open(folder / "int8"), Context(lambda what, _: said.append(what))), said


def test_variants_of_one_policy_are_called_by_their_folders(told: tuple[Report, list[str]]):
    rows = told[0].rows
    assert [(row.name, row.role) for row in rows] == [("float32", "baseline"), ("int8", "subject")]


@pytest.mark.parametrize(("paths", "names", "wanted"), [
    (("out/a", "out/b"), ("p", "p"), ["a", "b"]), (("a/bundle", "b/bundle"), ("p", "p"), ["a/bundle", "b/bundle"]),
    (("out/a", "out/b"), ("p", "q"), ["baseline", "q"]), (("out/a", "out/a"), ("p", "p"), ["baseline", "p"]),
    (("out/a",), ("p",), ["p"]),
])  # fmt: skip
def test_as_much_of_a_path_as_it_takes(folder: Path, paths: tuple[str, ...], names: tuple[str, ...], wanted: list[str]):
    manifest = Bundle.open(folder / "int8").manifest
    bundles = [Bundle(Path(path), replace(manifest, name=name)) for path, name in zip(paths, names, strict=True)]
    assert names_of(bundles) == wanted


def test_progress_says_whose_episodes_it_is_of(told: tuple[Report, list[str]]):
    said = [line for line in told[1] if " episodes: " in line]
    assert [line.split(": ")[0] for line in said] == [
        "float32, the baseline", "float32, the baseline", "int8", "int8",
        "the control, random actions", "the control, random actions",
        "the control, constant actions", "the control, constant actions",
        "float32, the baseline, under delay, strength 1", "float32, the baseline, under delay, strength 1",
        "int8, under delay, strength 1", "int8, under delay, strength 1",
        "float32, the baseline", "int8",
    ]  # fmt: skip


def test_progress_of_one_policy_alone_and_of_a_control_that_is_asked_for(folder: Path):
    said: list[str] = []
    context = Context(lambda what, _: said.append(what))
    loop(folder).run(Bundle.open(folder / "int8"), context)
    assert all(line.startswith(("1 of 2 episodes: ", "2 of 2 episodes: ")) for line in said)
    said.clear()
    loop(folder, control="random").run(Bundle.open(folder / "int8"), context)
    assert all(line.startswith("the control, random actions: ") for line in said)


@pytest.mark.parametrize("broken", ["float32", "int8"])
def test_a_bundle_that_this_processor_refuses_is_refused_before_the_first_episode(
    folder: Path, tmp_path: Path, broken: str
):
    wrong = shutil.copytree(folder / broken, tmp_path / broken)
    arrays = open_npz(wrong / GOLDEN)
    arrays["out.action"] = arrays["out.action"] + 1
    save_npz(wrong / GOLDEN, arrays)
    seal(wrong, Bundle.open(folder / broken).manifest)
    places = {"float32": folder / "float32", "int8": folder / "int8", broken: wrong}
    said: list[str] = []
    stage = loop(folder, baseline=places["float32"])
    with pytest.raises(GraphError, match="a different golden action"):
        stage.run(Bundle.open(places["int8"]), Context(lambda what, _: said.append(what)))
    assert not [line for line in said if "succeed" in line]


@pytest.mark.parametrize(("name", "remark"), [("baseline", ""), ("float32", "float32, baseline")])
def test_a_role_that_is_the_name_is_not_said_again(name: str, remark: str):
    rows = (Row(name, "baseline", measurements=(Measurement("success", 1.0, "1"),)), Row("b"))
    (section,) = Variants().build(Report("evaluate", "a title", rows=rows))
    (table,) = section.blocks
    assert isinstance(table, Table)
    assert [line.remark for line in table.lines] == [remark, ""]
