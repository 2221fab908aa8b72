"""BabyAI GoToLocal as the policy sees it: stacked egocentric RGB frames, previous actions, an instruction.

minigrid is imported only when an environment is made, so that a caller can report a missing package.
"""

from __future__ import annotations

import contextlib
import io
from functools import cache
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

FRAMES = 8
ACTIONS = ("left", "right", "forward")  # the same ids as minigrid's own first three actions
NO_ACTION = len(ACTIONS)
VIEW = 7  # tiles along one side of the egocentric view; the agent stands in the middle of the last row
TILE = 8  # pixels along one side of a tile
PIXELS = VIEW * TILE
COLOURS = ("red", "green", "blue", "purple", "yellow", "grey")
TYPES = ("key", "ball", "box")
# One code per kind of tile; the objects follow, all colours of the first type, then of the next.
BLANK, UNSEEN, EMPTY, WALL, AGENT, FIRST_OBJECT = range(6)
CODES = FIRST_OBJECT + len(TYPES) * len(COLOURS)
HEADINGS = ((1, 0), (0, 1), (-1, 0), (0, -1))  # forward (x, y) of minigrid's agent_dir
WRONG_INSTRUCTION_STREAM = 20_011  # keeps the draw of a wrong instruction apart from the level's own draws

Observation = dict[str, Any]


@cache
def tile_images() -> NDArray[np.uint8]:
    """Pixels of every tile code, (CODES, 8, 8, 3), drawn by minigrid's own renderer."""
    from minigrid.core.grid import Grid
    from minigrid.core.world_object import Ball, Box, Key, Wall

    def draw(thing: Any, visible: bool = True, heading: int | None = None) -> NDArray[np.uint8]:
        return Grid.render_tile(thing, agent_dir=heading, highlight=visible, tile_size=TILE).astype(np.uint8)

    blank = np.zeros((TILE, TILE, 3), np.uint8)
    special = [blank, draw(None, visible=False), draw(None), draw(Wall()), draw(None, heading=3)]
    return np.stack(special + [draw(kind(colour)) for kind in (Key, Ball, Box) for colour in COLOURS])


def render(codes: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Tile codes (..., 7, 7) to RGB (..., 56, 56, 3), equal to minigrid's RGBImgPartialObsWrapper(tile_size=8)."""
    tiles = tile_images()[codes]  # (..., 7, 7, 8, 8, 3)
    return np.moveaxis(tiles, -3, -4).reshape(*codes.shape[:-2], PIXELS, PIXELS, 3)


def floor_codes(grid: Any) -> NDArray[np.uint8]:
    """Tile codes of a whole minigrid level, indexed [y, x], with a border of unseen tiles one view wide."""
    codes = np.full((grid.height + 2 * VIEW, grid.width + 2 * VIEW), UNSEEN, np.uint8)
    for index, thing in enumerate(grid.grid):
        y, x = divmod(index, grid.width)
        codes[y + VIEW, x + VIEW] = tile_code(thing)
    return codes


def tile_code(thing: Any) -> int:
    """Code of one visible grid cell."""
    if thing is None:
        return EMPTY
    if thing.type == "wall":
        return WALL
    return FIRST_OBJECT + TYPES.index(thing.type) * len(COLOURS) + COLOURS.index(thing.color)


def _view_offsets(heading: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Offsets (y, x), each (7, 7), from the agent to every tile of its view."""
    ahead, side = np.mgrid[VIEW - 1 : -1 : -1, -(VIEW // 2) : VIEW // 2 + 1]
    forward_x, forward_y = HEADINGS[heading]
    return VIEW + ahead * forward_y + side * forward_x, VIEW + ahead * forward_x - side * forward_y


VIEW_OFFSETS = tuple(_view_offsets(heading) for heading in range(4))


def egocentric_view(floor: NDArray[np.uint8], x: int, y: int, heading: int) -> NDArray[np.uint8]:
    """Tile codes (7, 7) that the agent sees. One convex room: every tile up to the walls is visible."""
    rows, columns = VIEW_OFFSETS[heading]
    codes = floor[y + rows, x + columns]
    codes[VIEW - 1, VIEW // 2] = AGENT
    return codes


def wrong_instruction(colour: str, kind: str, seed: int) -> str:
    """Name one of the 17 other (colour, type) pairs, drawn uniformly from `seed`, whether in the room or not."""
    others = [(c, k) for c in COLOURS for k in TYPES if (c, k) != (colour, kind)]
    choice = others[np.random.default_rng((WRONG_INSTRUCTION_STREAM, seed)).integers(len(others))]
    return f"go to the {choice[0]} {choice[1]}"


class GoToLocal(gymnasium.Env[Observation, int]):
    """One GoToLocal level; the last 8 frames and 7 actions are the observation, so the policy needs no state.

    Attributes:
        level: minigrid's own environment, which moves the agent and judges success.
        view_codes: (8, 7, 7) tile codes of the frames of the current observation.
    """

    def __init__(self, task: str, instruction: str = "right") -> None:
        if instruction not in ("right", "wrong"):
            raise ValueError(f"instruction must be 'right' or 'wrong', got {instruction!r}")
        import minigrid  # noqa: F401  (registers the levels with gymnasium)

        level: Any = gymnasium.make(f"BabyAI-{task}-v0", disable_env_checker=True).unwrapped
        level.gen_obs = dict  # minigrid would encode its own observation at every step, unused here
        self.level = level
        self.instruction_mode = instruction
        self.observation_space = gymnasium.spaces.Dict(
            {
                "image": gymnasium.spaces.Box(0, 255, (FRAMES, PIXELS, PIXELS, 3), np.uint8),
                "actions": gymnasium.spaces.MultiDiscrete([len(ACTIONS) + 1] * (FRAMES - 1)),
                "instruction": gymnasium.spaces.Text(64, charset="abcdefghijklmnopqrstuvwxyz "),
            }
        )
        self.action_space = gymnasium.spaces.Discrete(len(ACTIONS))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Generate the level of `seed` and return its first observation."""
        super().reset(seed=seed)
        seed = int(self.np_random.integers(2**31)) if seed is None else seed
        with contextlib.redirect_stdout(io.StringIO()):  # minigrid prints "Sampling rejected"
            self.level.reset(seed=seed)
        target = self.level.instrs.desc
        wrong = self.instruction_mode == "wrong"
        self.instruction = wrong_instruction(target.color, target.type, seed) if wrong else self.level.mission
        self._floor = floor_codes(self.level.grid)
        self.view_codes = np.full((FRAMES, VIEW, VIEW), BLANK, np.uint8)
        self.past_actions = np.full(FRAMES - 1, NO_ACTION, np.int64)
        self._remember_view()
        return self._observation(), {"mission": self.level.mission}

    def step(self, action: int) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Take action 0 left, 1 right or 2 forward; `success` stands in the info of every step."""
        truncated, success = self.move(action)
        return self._observation(), float(success), success, truncated and not success, {"success": success}

    def move(self, action: int) -> tuple[bool, bool]:
        """Act without rendering; returns whether the time is up and whether the mission is accomplished."""
        _, reward, _, truncated, _ = self.level.step(int(action))
        self.past_actions = np.append(self.past_actions[1:], int(action))
        self._remember_view()
        return bool(truncated), bool(reward > 0)

    def _remember_view(self) -> None:
        x, y = self.level.agent_pos
        view = egocentric_view(self._floor, x, y, self.level.agent_dir)
        self.view_codes = np.concatenate((self.view_codes[1:], view[None]))

    def _observation(self) -> Observation:
        return {"image": render(self.view_codes), "actions": self.past_actions, "instruction": self.instruction}


def make(task: str, instruction: str = "right") -> gymnasium.Env[Observation, int]:
    """Make the environment of `task` ("GoToLocalS6N3", "GoToLocal", ...).

    With instruction="wrong" the policy is told of another (colour, type), drawn from the seed of the episode, while
    success is still judged by the true mission.
    """
    return GoToLocal(task, instruction)
