"""BabyAI GoToLocal as the policy sees it: stacked egocentric RGB frames, previous actions, an instruction.

minigrid is imported only when an environment is made, so that a caller can report a missing package.
The info of every reset and step tells where the agent is, and `disturb` makes the next episodes harder: see README.md.
"""

from __future__ import annotations

import contextlib
import io
import math
import zlib
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
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
# What a disturbance of strength 1 changes, as README.md says it; each is drawn anew for every seed.
START_CELLS = 2  # how far away the agent starts, at most
SHIFT = 1  # pixels; whole ones, at least one
BRIGHTNESS, TINT = 0.15, 0.05  # of the logarithm of the gain of all channels, and of each one, at most
PIXEL_NOISE = 12.0  # standard deviation, grey levels of 255
DARK_SHARE = 0.04  # of the image
# Wordings that training did not use: it always said "go to the COLOUR TYPE" or, of several, "go to a COLOUR TYPE".
REWORDED = ("to {article} {thing}", "go to {thing}", "go {article} {thing}")
SHORT = "{thing}"

Cell = tuple[int, int]  # x, y
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


def walking_distances(grid: Any, start: Cell) -> dict[Cell, int]:
    """Every cell that can be reached from `start` over free ones, with the number of moves that takes."""
    distances, queue = {start: 0}, deque([start])
    while queue:
        cell = queue.popleft()
        for neighbour in neighbours(cell):
            if neighbour not in distances and grid.get(*neighbour) is None:
                distances[neighbour] = distances[cell] + 1
                queue.append(neighbour)
    return distances


def neighbours(cell: Cell) -> list[Cell]:
    """The cells around one, in the order of `HEADINGS`."""
    return [(cell[0] + x, cell[1] + y) for x, y in HEADINGS]


def pose(level: Any) -> tuple[Cell, int]:
    """Cell and heading of the agent."""
    x, y = level.agent_pos
    return (int(x), int(y)), int(level.agent_dir)


def targets(level: Any) -> set[Cell]:
    """The cells of all objects that fit the mission of a level."""
    return {(int(x), int(y)) for x, y in level.instrs.desc.obj_poss}


def shortest_path(grid: Any, start: Cell, goals: Iterable[Cell]) -> float:
    """Moves from `start` to the nearest cell beside a goal, from where the agent only has to turn to it."""
    beside = {cell for goal in goals for cell in neighbours(goal)}
    return float(min((n for cell, n in walking_distances(grid, start).items() if cell in beside), default=math.inf))


@dataclass(frozen=True)
class Disturbance:
    """What is different in an episode. All of it is drawn from the seed and the kind; without a kind, nothing is."""

    kind: str = ""
    strength: float = 0.0
    seed: int = 0

    def random(self, step: int = 0) -> np.random.Generator:
        """What this disturbance draws from at a step of the episode."""
        return np.random.default_rng([self.seed, zlib.crc32(self.kind.encode()), step])

    def move_start(self, level: Any) -> None:
        """Put the agent on another cell nearby, or turn it, with no object of the mission right in front."""
        if self.kind != "start_pose":
            return
        moves = walking_distances(level.grid, pose(level)[0])
        near = [cell for cell, number in moves.items() if number <= self.strength * START_CELLS]
        poses = [(c, h) for c in near for h in range(4) if neighbours(c)[h] not in targets(level)]
        poses = [new for new in poses if new != pose(level)]
        if poses:
            level.agent_pos, level.agent_dir = poses[self.random().integers(len(poses))]

    def images(self, images: NDArray[np.uint8], step: int) -> NDArray[np.uint8]:
        """The frames (8, 56, 56, 3) at a step, shifted, partly covered, noisy or in another light."""
        if self.kind == "camera_shift":
            angle, border = self.random().uniform(0, 2 * math.pi), math.ceil(self.strength * SHIFT)
            y, x = border + round(border * math.sin(angle)), border + round(border * math.cos(angle))
            padded = np.pad(images, ((0, 0), (border, border), (border, border), (0, 0)), mode="edge")
            return padded[:, y : y + PIXELS, x : x + PIXELS]
        if self.kind == "occlusion":
            side = min(round(PIXELS * math.sqrt(self.strength * DARK_SHARE)), PIXELS)
            y, x = self.random().integers(PIXELS - side + 1, size=2)
            covered = images.copy()
            covered[:, y : y + side, x : x + side] = 0
            return covered
        if self.kind == "light":
            random = self.random()
            gain = BRIGHTNESS * random.uniform(-1, 1) + TINT * random.uniform(-1, 1, 3)
            return np.clip(np.rint(images * np.exp(self.strength * gain)), 0, 255).astype(np.uint8)
        if self.kind == "sensor_noise":
            noise = np.zeros(images.shape)
            for age in range(min(step + 1, FRAMES)):  # a frame keeps the noise that it was taken with
                noise[-1 - age] = self.random(step - age).normal(size=images.shape[1:])
            return np.clip(np.rint(images + self.strength * PIXEL_NOISE * noise), 0, 255).astype(np.uint8)
        return images

    def instruction(self, instruction: str) -> str:
        """Other words for the same, in a share `strength` of the seeds; above 1, some name the object alone."""
        if self.kind != "wording":
            return instruction
        random = self.random()
        reworded = REWORDED[random.integers(len(REWORDED))]
        share = random.uniform()
        if share >= self.strength:
            return instruction
        _, _, article, thing = instruction.split(maxsplit=3)
        return (SHORT if share < self.strength - 1 else reworded).format(article=article, thing=thing)


class GoToLocal(gymnasium.Env[Observation, int]):
    """One GoToLocal level; the last 8 frames and 7 actions are the observation, so the policy needs no state.

    Attributes:
        level: minigrid's own environment, which moves the agent and judges success.
        view_codes: (8, 7, 7) tile codes of the frames of the current observation, without any disturbance.
        disturbances: the kinds that `disturb` knows.
    """

    disturbances = ("start_pose", "camera_shift", "light", "sensor_noise", "wording", "occlusion")

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
        self._disturbance = self._next_disturbance = Disturbance()

    def disturb(self, kind: str, strength: float, seed: int) -> None:
        """Make the episodes from the next reset on differ by one of `disturbances`.

        Strength 0 changes nothing, 1 is an ordinary day in a lab, and 2 is twice that. What is drawn depends on the
        seed and the kind alone; the level stays that of the episode's own seed.
        """
        if kind not in self.disturbances:
            raise ValueError(f"unknown disturbance {kind!r}; known: {', '.join(self.disturbances)}")
        if not 0 <= strength < math.inf:
            raise ValueError(f"the strength of a disturbance must be 0 or more, not {strength}")
        self._next_disturbance = Disturbance(kind, strength, seed) if strength else Disturbance()

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
        self._disturbance = self._next_disturbance
        self._disturbance.move_start(self.level)
        told = wrong_instruction(target.color, target.type, seed) if wrong else self.level.mission
        self.instruction = self._disturbance.instruction(told)
        self._floor = floor_codes(self.level.grid)
        self.view_codes = np.full((FRAMES, VIEW, VIEW), BLANK, np.uint8)
        self.past_actions = np.full(FRAMES - 1, NO_ACTION, np.int64)
        self._remember_view()
        path = shortest_path(self.level.grid, pose(self.level)[0], targets(self.level))
        return self._observation(), {"mission": self.level.mission, "shortest_path": path, **self._where()}

    def step(self, action: int) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Take action 0 left, 1 right or 2 forward; `success` stands in the info of every step."""
        before = pose(self.level)[0]
        truncated, success = self.move(action)
        collision = ACTIONS[int(action)] == "forward" and pose(self.level)[0] == before and not success
        info = {"success": success, "collision": collision, **self._where()}
        return self._observation(), float(success), success, truncated and not success, info

    def move(self, action: int) -> tuple[bool, bool]:
        """Act without rendering; returns whether the time is up and whether the mission is accomplished."""
        _, reward, _, truncated, _ = self.level.step(int(action))
        self.past_actions = np.append(self.past_actions[1:], int(action))
        self._remember_view()
        return bool(truncated), bool(reward > 0)

    def _where(self) -> dict[str, Any]:
        """Position (x, y in cells) and heading (rad, from x towards y, which points down)."""
        cell, heading = pose(self.level)
        return {"position": np.array(cell, float), "heading": heading * math.pi / 2}

    def _remember_view(self) -> None:
        (x, y), heading = pose(self.level)
        view = egocentric_view(self._floor, x, y, heading)
        self.view_codes = np.concatenate((self.view_codes[1:], view[None]))

    def _observation(self) -> Observation:
        image = self._disturbance.images(render(self.view_codes), self.level.step_count)
        return {"image": image, "actions": self.past_actions, "instruction": self.instruction}


def make(task: str, instruction: str = "right") -> gymnasium.Env[Observation, int]:
    """Make the environment of `task` ("GoToLocalS6N3", "GoToLocal", ...).

    With instruction="wrong" the policy is told of another (colour, type), drawn from the seed of the episode, while
    success is still judged by the true mission.
    """
    return GoToLocal(task, instruction)
