"""The distance of two simulated arms, between their geometries as MuJoCo has them."""

from __future__ import annotations

from typing import Any

import numpy as np

from vlatool.errors import UsageError

FAR_M = 1.0
"""Distance above which the exact one does not matter, in metres."""


class ArmDistance:
    """Distance of all geometries of two trees of bodies.

    Args:
        one, two: Roots of the trees, bodies of the model.
    """

    def __init__(self, mujoco: Any, model: Any, one: str, two: str) -> None:
        self._mujoco, self._model = mujoco, model
        self._one, self._two = _geometries(model, one), _geometries(model, two)
        self._sizes = model.geom_rbound[self._one][:, None] + model.geom_rbound[self._two][None, :]

    def measure(self, data: Any) -> float:
        """Return the distance in metres, at most ``FAR_M``."""
        places = data.geom_xpos
        gaps = np.linalg.norm(places[self._one][:, None] - places[self._two][None, :], axis=-1) - self._sizes
        nearest, ends = FAR_M, np.zeros(6)
        for index in np.argsort(gaps, axis=None).tolist():
            row, column = divmod(index, len(self._two))
            if gaps[row, column] >= nearest:
                break
            found = self._mujoco.mj_geomDistance(self._model, data, self._one[row], self._two[column], nearest, ends)
            nearest = min(nearest, found)
        return float(nearest)


def _geometries(model: Any, root: str) -> list[int]:
    """Return the geometries of a body and of all bodies below it."""
    names = [model.body(index).name for index in range(model.nbody)]
    if root not in names:
        raise UsageError(f"The model has no body '{root}'.", "use the version of the package that was tried")
    inside = {names.index(root)}
    for body in range(model.nbody):  # a parent comes before its children
        if model.body_parentid[body] in inside:
            inside.add(body)
    return [geometry for geometry in range(model.ngeom) if model.geom_bodyid[geometry] in inside]
