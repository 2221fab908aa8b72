"""An unstable simulation ends with an error, and leaves no file behind."""

from __future__ import annotations

from pathlib import Path

import pytest

from vlatool.errors import InputError
from vlatool.worlds._simulation import advance_model, load_mujoco

pytest.importorskip("mujoco")
MODEL = '<mujoco><worldbody><body><freejoint/><geom size="0.1" mass="1"/></body></worldbody></mujoco>'


@pytest.mark.parametrize("where", ["qpos", "qvel"])
def test_an_unstable_simulation_is_an_error_and_writes_no_file(
    where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    mujoco = load_mujoco()
    model = mujoco.MjModel.from_xml_string(MODEL)
    data = mujoco.MjData(model)
    advance_model(mujoco, model, data)
    getattr(data, where)[0] = float("nan")
    with pytest.raises(InputError, match="became unstable at"):
        advance_model(mujoco, model, data)
    assert not list(tmp_path.iterdir())
