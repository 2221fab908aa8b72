"""Meta-World v3 tasks as gymnasium environments with raw physical observations and metric actions.

An observation is a mapping with the keys `image` (uint8 96 x 96 x 3), `proprio` (float32 x, y, z in metres and the
gripper opening 0..1) and `instruction` (str). The image is rendered lazily: only when `observation["image"]` is read
the first time, which must happen before the next `step` or `reset`. Software rendering takes far longer than
a physics step, and a policy that executes four actions per inference looks at one frame in four.

The info of every reset and step tells how the arm stands, and `disturb` makes the next episodes harder: see README.md.
"""

import atexit
import contextlib
import math
import os
import string
import weakref
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

IMAGE_SIZE = 96
MAX_STEPS = 200
METRES_PER_UNIT = 0.01
INSTRUCTIONS: dict[str, tuple[str, ...]] = {
    "button-press": ("press the button", "push the red button"),
    "drawer-open": ("open the drawer", "pull the drawer open"),
    "drawer-close": ("close the drawer", "push the drawer shut"),
    "door-open": ("open the door", "pull the door open"),
    "window-open": ("open the window", "slide the window open"),
    "window-close": ("close the window", "slide the window shut"),
    "faucet-open": ("open the faucet", "turn the faucet on"),
    "faucet-close": ("close the faucet", "turn the faucet off"),
}
TASKS = tuple(INSTRUCTIONS)
# Wordings that training did not use (it used those above, and no others), of words that vocabulary.json knows.
REWORDED: dict[str, tuple[str, ...]] = {
    "button-press": ("push the button", "press the red button"),
    "drawer-open": ("pull open the drawer", "slide the drawer open"),
    "drawer-close": ("shut the drawer", "slide the drawer shut"),
    "door-open": ("pull open the door", "slide the door open"),
    "window-open": ("slide open the window", "push the window open"),
    "window-close": ("shut the window", "push the window shut"),
    "faucet-open": ("turn on the faucet", "turn the faucet open"),
    "faucet-close": ("turn off the faucet", "turn the faucet shut"),
}
VIEW = np.array([125.0, -38.0, 0.0, 0.68, 0.14])  # the camera: azimuth, elevation (degrees), where it looks x, y, z (m)
# What a disturbance of strength 1 changes, as README.md says it; each is drawn anew for every seed.
START_SHIFT = 0.05  # m
VIEW_SHIFT = np.array([3.0, 3.0, 0.02, 0.02, 0.02])  # as VIEW, at most
BRIGHTNESS, TINT = 0.08, 0.02  # of the logarithm of the gain of all channels, and of each one, at most
PROPRIO_NOISE, PIXEL_NOISE = 0.005, 12.0  # standard deviations: m, and grey levels of 255


@dataclass(frozen=True)
class Disturbance:
    """What is different in an episode. All of it is drawn from the seed and the kind; without a kind, nothing is."""

    kind: str = ""
    strength: float = 0.0
    seed: int = 0

    def random(self, step: int = 0) -> np.random.Generator:
        """What this disturbance draws from at a step of the episode."""
        return np.random.default_rng([self.seed, zlib.crc32(self.kind.encode()), step])

    def start(self, hand: np.ndarray, lowest: np.ndarray, highest: np.ndarray) -> np.ndarray:
        """Where the hand starts: elsewhere within its limits, but no lower, for there the objects are."""
        if self.kind != "start_pose":
            return hand
        direction = self.random().normal(size=3)
        direction[2] = abs(direction[2])
        return np.clip(hand + self.strength * START_SHIFT * direction / np.linalg.norm(direction), lowest, highest)

    def view(self) -> np.ndarray:
        """The pose of the camera, as `VIEW`."""
        if self.kind != "camera_shift":
            return VIEW
        return VIEW + self.strength * VIEW_SHIFT * self.random().uniform(-1, 1, len(VIEW))

    def image(self, image: np.ndarray, step: int) -> np.ndarray:
        """The image of the camera in another light, or with noise."""
        if self.kind == "light":
            random = self.random()
            gain = BRIGHTNESS * random.uniform(-1, 1) + TINT * random.uniform(-1, 1, 3)
            image = image * np.exp(self.strength * gain)
        elif self.kind == "sensor_noise":
            image = image + self.strength * PIXEL_NOISE * self.random(step).normal(size=image.shape)
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)

    def proprio(self, proprio: np.ndarray, step: int) -> np.ndarray:
        """The measured position of the hand, with noise; the gripper has none."""
        if self.kind != "sensor_noise":
            return proprio
        noise = self.strength * PROPRIO_NOISE * self.random(step).normal(size=3)
        return np.append(proprio[:3] + noise, proprio[3]).astype(np.float32)

    def instruction(self, task: str, instruction: str) -> str:
        """Other words for the same task, in a share `strength` of the seeds; above 1, some lack "the" as well."""
        if self.kind != "wording":
            return instruction
        random = self.random()
        reworded = REWORDED[task][random.integers(len(REWORDED[task]))]
        share = random.uniform()
        if share >= self.strength:
            return instruction
        return reworded.replace("the ", "") if share < self.strength - 1 else reworded


class LazyObservation(Mapping[str, Any]):
    """Read-only observation whose image is rendered on first access."""

    def __init__(self, proprio: np.ndarray, instruction: str, render: Callable[[], np.ndarray]) -> None:
        self._values: dict[str, Any] = {"proprio": proprio, "instruction": instruction}
        self._render: Callable[[], np.ndarray] | None = render

    def __getitem__(self, key: str) -> Any:
        if key == "image" and "image" not in self._values:
            if self._render is None:
                raise RuntimeError("the image of this observation was not read before the next step or reset")
            self._values["image"] = self._render()
        return self._values[key]

    def __iter__(self) -> Iterator[str]:
        return iter(("image", "proprio", "instruction"))

    def __len__(self) -> int:
        return 3

    def expire(self) -> None:
        """Forbids late rendering: the simulation has moved on."""
        self._render = None


class MetaWorldEnv(gymnasium.Env[Mapping[str, Any], np.ndarray]):
    """One Meta-World task, seeded per episode, ending at success or truncated after `MAX_STEPS` control steps."""

    disturbances = ("start_pose", "camera_shift", "light", "sensor_noise", "wording")

    def __init__(self, task: str, instruction: str = "right") -> None:
        if task not in INSTRUCTIONS:
            raise ValueError(f"unknown task {task!r}; known: {', '.join(TASKS)}")
        if instruction not in ("right", "wrong"):
            raise ValueError(f"instruction must be 'right' or 'wrong', not {instruction!r}")
        os.environ.setdefault("MUJOCO_GL", "egl")
        self.task = task
        self.simulation = _make_simulation(task)
        self.observation_space = spaces.Dict(
            image=spaces.Box(0, 255, (IMAGE_SIZE, IMAGE_SIZE, 3), np.uint8),
            proprio=spaces.Box(-np.inf, np.inf, (4,), np.float32),
            instruction=spaces.Text(64, charset=string.ascii_lowercase + " "),
        )
        limit = np.array([METRES_PER_UNIT] * 3 + [1.0], np.float32)
        self.action_space = spaces.Box(-limit, limit, dtype=np.float32)
        self._wrong = instruction == "wrong"
        self._camera: _Camera | None = None
        self._observation: LazyObservation | None = None
        self._instruction = ""
        self._steps = 0
        self._hand = self.simulation.hand_init_pos
        self._joints = [int(self.simulation.model.joint(f"right_j{index}").qposadr[0]) for index in range(7)]
        self._disturbance = self._next_disturbance = Disturbance()

    def disturb(self, kind: str, strength: float, seed: int) -> None:
        """Makes the episodes from the next reset on differ by one of `disturbances`.

        Strength 0 changes nothing, 1 is an ordinary day in a lab, and 2 is twice that. What is drawn depends on the
        seed and the kind alone; the scene stays that of the episode's own seed.
        """
        if kind not in self.disturbances:
            raise ValueError(f"unknown disturbance {kind!r}; known: {', '.join(self.disturbances)}")
        if not 0 <= strength < math.inf:
            raise ValueError(f"the strength of a disturbance must be 0 or more, not {strength}")
        self._next_disturbance = Disturbance(kind, strength, seed) if strength else Disturbance()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts the episode that `seed` names; Meta-World's own reset ignores its seed argument."""
        import mujoco

        super().reset(seed=seed)
        episode_seed = int(self.np_random.integers(2**31)) if seed is None else seed
        self._disturbance = self._next_disturbance
        limits = self.simulation.mocap_low, self.simulation.mocap_high
        self.simulation.hand_init_pos = self._disturbance.start(self._hand, *limits)
        self.simulation.seed(episode_seed)
        self.simulation.reset()
        mujoco.mj_forward(self.simulation.model, self.simulation.data)  # reset leaves stale object poses
        self._instruction = self._choose_instruction(episode_seed)
        self._steps = 0
        return self._observe(success=False)

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Executes one control step: dx, dy, dz in metres and the gripper effort."""
        values = np.asarray(action, np.float64)
        command = np.clip(np.append(values[:3] / METRES_PER_UNIT, values[3]), -1.0, 1.0)
        _, reward, _, _, info = self.simulation.step(command)
        self._steps += 1
        success = bool(info["success"])
        truncated = not success and self._steps >= MAX_STEPS
        observation, info = self._observe(success)
        return observation, float(reward), success, truncated, info

    def close(self) -> None:
        """Frees the renderer; physics needs no closing."""
        if self._camera is not None:
            self._camera.close()
            self._camera = None

    def _choose_instruction(self, seed: int) -> str:
        """Picks the wording (and, for the control, the wrong task) from the episode seed alone."""
        generator = np.random.default_rng([seed, 7])
        others = [task for task in TASKS if task != self.task]
        told = others[generator.integers(len(others))] if self._wrong else self.task
        instruction = INSTRUCTIONS[told][generator.integers(len(INSTRUCTIONS[told]))]
        return self._disturbance.instruction(told, instruction)

    def _observe(self, success: bool) -> tuple[LazyObservation, dict[str, Any]]:
        """What the policy sees, and the info: how the arm really stands, whatever its sensors say."""
        if self._observation is not None:
            self._observation.expire()
        hand = self.simulation._get_curr_obs_combined_no_goal()[:4]
        proprio = self._disturbance.proprio(hand.astype(np.float32), self._steps)
        self._observation = LazyObservation(proprio, self._instruction, self._render_image)
        info = {
            "success": success,
            "task": self.task,
            "position": hand[:3],  # of the hand: x, y, z in m
            "joints": self.simulation.data.qpos[self._joints],  # of the arm, rad
            "gripper": float(hand[3]),  # 0 closed, 1 open
        }
        return self._observation, info

    def _render_image(self) -> np.ndarray:
        if self._camera is None:
            self._camera = _Camera(self.simulation.model)
        image = self._camera.capture(self.simulation.data, self._disturbance.view())
        return self._disturbance.image(image, self._steps)


@contextlib.contextmanager
def _headless_rendering() -> Iterator[None]:
    """Says which system packages are missing where MuJoCo only says that something could not be imported."""
    try:
        yield
    except ModuleNotFoundError:
        raise
    except Exception as error:
        raise RuntimeError(
            f"headless rendering ({os.environ['MUJOCO_GL']}) does not start: {error}. It needs the Debian packages "
            "libegl1, libgl1 and libosmesa6: apt-get install libegl1 libgl1 libosmesa6, or set MUJOCO_GL=osmesa"
        ) from error


class _Camera:
    """A free camera with every costly rendering effect and all goal markers switched off."""

    def __init__(self, model: Any) -> None:
        with _headless_rendering():
            import mujoco

        model.vis.quality.offsamples = 0
        model.vis.quality.shadowsize = 256
        with _headless_rendering():
            self._renderer = mujoco.Renderer(model, IMAGE_SIZE, IMAGE_SIZE)
        # Registered after mujoco's own exit handler, hence run before it: a later close prints EGL errors.
        atexit.register(_close_if_alive, weakref.ref(self._renderer))
        self._view = mujoco.MjvCamera()
        self._view.type = mujoco.mjtCamera.mjCAMERA_FREE
        self._view.distance = 0.85
        self._options = mujoco.MjvOption()
        self._options.sitegroup[:] = 0
        flags = mujoco.mjtRndFlag
        self._disabled = (flags.mjRND_SHADOW, flags.mjRND_REFLECTION, flags.mjRND_SKYBOX, flags.mjRND_HAZE)

    def capture(self, data: Any, view: np.ndarray) -> np.ndarray:
        """Renders the simulation state, seen as `view` says, as uint8 (96, 96, 3)."""
        self._view.azimuth, self._view.elevation, self._view.lookat[:] = view[0], view[1], view[2:]
        self._renderer.update_scene(data, self._view, self._options)
        for flag in self._disabled:
            self._renderer.scene.flags[flag] = 0
        return self._renderer.render()

    def close(self) -> None:
        """Frees the rendering context."""
        self._renderer.close()


def _close_if_alive(renderer: "weakref.ref[Any]") -> None:
    """Closes a renderer that still exists at exit."""
    alive = renderer()
    if alive is not None:
        alive.close()


def _make_simulation(task: str) -> Any:
    """Builds the Meta-World environment with a freshly drawn, seeded scene at every reset."""
    with _headless_rendering():
        from metaworld.env_dict import ALL_V3_ENVIRONMENTS

    simulation = ALL_V3_ENVIRONMENTS[f"{task}-v3"]()
    simulation._freeze_rand_vec = False
    simulation.seeded_rand_vec = True
    simulation._set_task_called = True
    return simulation


def make(task: str, instruction: str = "right") -> MetaWorldEnv:
    """Makes the environment of one task; `instruction="wrong"` tells it another task's instruction."""
    return MetaWorldEnv(task, instruction)
