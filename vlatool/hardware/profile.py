"""A hardware target: what a board has, who says so, and where the profiles are found.

Every figure says where it comes from. ``kind`` is ``vendor`` (a data sheet), ``measured`` (on that board), ``derived``
(computed from figures that were seen), ``estimate`` (a judgement) or ``unverified`` (recalled, to be checked).
"""

from __future__ import annotations

import contextlib
import difflib
import importlib.util
import os
import re
from collections.abc import Mapping
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, ConfigDict, Field, PositiveFloat, ValidationError, model_validator

from vlatool import registry
from vlatool.errors import OutputError, ProfileError, fix_for, suggest
from vlatool.files.numbers import Numeric
from vlatool.files.user_files import remove_stamp, write_own_file
from vlatool.files.yaml import read_mapping
from vlatool.hardware._problems import describe_problem, name_problems, source_problems

SEARCH_PATH = "VLATOOL_PROFILES"
SUFFIXES = (".yaml", ".yml")
NAME = r"^[a-z0-9][a-z0-9-]*$"

Kind = Literal["vendor", "measured", "derived", "estimate", "unverified"]
COMPUTE_DTYPES = ("float32", "float16", "bfloat16", "float8", "int8", "w8", "w4")
"""Precisions of a candidate: a dtype of weights and activations, or of weights alone."""
DTYPES = ("float32", "tf32", "float16", "bfloat16", "float8", "int8", "int4", "float4")


def _one_of(known: tuple[str, ...], what: str) -> AfterValidator:
    def check(name: str) -> str:
        if name not in known:
            raise ValueError(f"is not {what}; {suggest(name, known)}")
        return name

    return AfterValidator(check)


def _version(text: str) -> str:
    if not re.fullmatch(r"[0-9]+(\.[0-9]+)*", text):
        raise ValueError(f"must be a version like '3.10'; got {text!r}")
    return text


Dtype = Annotated[str, _one_of(DTYPES, "a dtype")]
Computed = Annotated[str, _one_of(COMPUTE_DTYPES, "what an engine computes in")]
Version = Annotated[str, AfterValidator(_version)]


class Strict(Numeric):
    """Base of what a YAML file of a board or robot holds: frozen, and without unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Figure(Strict):
    """A number with its source; the unit is in the name of the field that holds it.

    Args:
        value: Above zero.
        kind: How well the number is founded.
        source: A key of the profile's ``sources``.
        note: Formula or reservation.
    """

    value: float = Field(gt=0)
    kind: Kind
    source: str
    note: str = ""


class Price(Figure):
    """A list price in the year in which it was asked."""

    year: int = Field(ge=2000)


class Unit(Strict):
    """A part of the board that computes: its processor cores or its GPU.

    Args:
        cores: Processor cores, or streaming multiprocessors / execution units of a GPU.
        clock_mhz: The highest clock; the peaks hold at it.
        bandwidth_gb_s: Bandwidth to memory, where that is less than the board's: a processor beside a graphics card,
            a module behind PCI Express.
        peak_tops: dtype -> 10^12 operations per second, dense, where a multiply-accumulate is two operations.
        isa: Instruction set features that inference libraries use, as ``/proc/cpuinfo`` names them. Those of an x86
            processor say what OpenVINO is confined to when a policy is optimized for it (``machine.instruction_sets``).
        absent: Features that a reader might expect and that are not there.
    """

    title: str
    cores: Figure
    clock_mhz: Figure
    bandwidth_gb_s: Figure | None = None
    peak_tops: dict[Dtype, Figure]
    isa: tuple[str, ...] = ()
    absent: tuple[str, ...] = ()


class EngineFigures(Strict):
    """An engine that runs on the board.

    Args:
        unit: Which of the profile's units computes.
        int8_layout: Types of activations and weights that int8 is fastest in; empty where int8 is not supported.
        integer_ops: Whether the int8 figures also hold for integer operators (MatMulInteger and its kin), not for QDQ
            alone.
        base_mb: Memory of a process that holds the engine and no model.
        runtime: Whose published latencies the predictions for it rest on (a runtime of the predictor's data); empty
            where there are none, and then latency is unknown.
        dtypes: What it computes in here, the fastest first; int4 and int8 weights alone are written ``w4`` and ``w8``.
    """

    unit: str
    int8_layout: Literal["u8s8", "s8s8", ""]
    integer_ops: bool
    base_mb: Figure
    runtime: str = ""
    dtypes: tuple[Computed, ...] = Field(min_length=1)
    note: str = ""


class PowerMode(Strict):
    """Caps of a power mode, in absolute numbers for each unit; ``kind`` and ``source`` speak for all of them.

    ``power_w`` is None when the mode has no budget.
    """

    power_w: float | None = Field(None, gt=0)
    cores: dict[str, PositiveFloat]
    clock_mhz: dict[str, PositiveFloat]
    bandwidth_gb_s: float = Field(gt=0)
    kind: Kind
    source: str
    note: str = ""


class Software(Strict):
    """What comes with one release of the board's system; ``engines``: engine -> the version that runs on it."""

    release: str
    os: str
    python: Version
    cuda: str | None = None
    tensorrt: str | None = None
    engines: dict[str, str] = Field(default_factory=dict)
    kind: Kind
    source: str


class Profile(Strict):
    """A hardware target.

    Args:
        name: Name on the command line; lower case, digits and hyphens.
        aliases: Other names that people type for it.
        model_strings: Names of the board in its firmware or processor (see ``vlatool.machine.host.matches``).
        memory_gb: Memory in GB (10^9 bytes), shared by CPU and GPU where ``unified``.
        usable_memory_gb: Memory left for a policy besides system, desktop and drivers.
        bandwidth_gb_s: Peak memory bandwidth.
        power_w: The most that the board draws.
        idle_w: Idle power.
        price_usd: What the board costs, or what it costs to have one of its kind installed (see the note).
        price_usd_per_hour: What an hour of it costs where it is rented: it then is a cloud machine, no board.
        storage: Storage that was tested to boot and to hold a policy.
        platforms: Robot platforms (see ``vlatool.hardware.platforms``) that commonly carry it.
        units: Name -> what computes (``cpu``, ``gpu``).
        engines: Engine -> how well it does here, the preferred one first.
        modes: Name -> power mode.
        default_mode: The mode in which the board starts.
        caveats: Caveats of plans for this board.
        sources: Key -> public reference.
    """

    name: str = Field(pattern=NAME)
    aliases: tuple[Annotated[str, Field(pattern=NAME)], ...] = ()
    title: str
    architecture: Literal["aarch64", "x86_64"]
    model_strings: tuple[str, ...] = Field(min_length=1)
    memory_gb: Figure
    memory_options_gb: tuple[float, ...] = ()
    usable_memory_gb: Figure
    unified: bool = True
    bandwidth_gb_s: Figure
    power_w: Figure
    idle_w: Figure | None = None
    price_usd: Price
    price_usd_per_hour: Price | None = None
    storage: tuple[str, ...] = ()
    platforms: tuple[str, ...] = ()
    units: dict[str, Unit] = Field(min_length=1)
    engines: dict[str, EngineFigures] = Field(min_length=1)
    modes: dict[str, PowerMode] = Field(min_length=1)
    default_mode: str
    software: tuple[Software, ...] = ()
    caveats: tuple[str, ...] = ()
    sources: dict[str, str] = Field(min_length=1)

    @model_validator(mode="after")
    def _consistent(self) -> Profile:
        problems = [*source_problems(self, self.sources), *name_problems(self)]
        if self.usable_memory_gb.value > self.memory_gb.value:
            problems.append("usable_memory_gb.value: is more than memory_gb")
        if problems:
            raise ProfileError(
                "\n".join(problems), "correct it in the profile's file; docs/reference/profiles.md has each field"
            )
        return self

    @property
    def engine(self) -> str:
        """The preferred engine."""
        return next(iter(self.engines))

    @property
    def int8_layout(self) -> str:
        """Types of activations and weights that the preferred engine computes int8 in: ``u8s8`` or ``s8s8``."""
        return self.engines[self.engine].int8_layout

    def mode(self, name: str | None = None) -> PowerMode:
        """Return a power mode, the default one for None; raises ProfileError when the board has no such mode."""
        chosen = self.default_mode if name is None else name
        if chosen not in self.modes:
            raise ProfileError(
                f"{self.name} has no power mode '{chosen}'; {suggest(chosen, self.modes)}.", fix_for(chosen, self.modes)
            )
        return self.modes[chosen]

    def peak_tops(self, unit: str, dtype: str, mode: str | None = None) -> float | None:
        """Return the dense peak in 10^12 operations per second in a power mode; None where it is not known.

        The peak scales with the cores that are on and with their clock.
        """
        caps, part = self.mode(mode), self.units[unit]
        if dtype not in part.peak_tops:
            return None
        cores = caps.cores.get(unit, part.cores.value) / part.cores.value
        clock = caps.clock_mhz.get(unit, part.clock_mhz.value) / part.clock_mhz.value
        return part.peak_tops[dtype].value * cores * clock


KEYS = {key for model in (Profile, Unit, EngineFigures, PowerMode, Software, Price) for key in model.model_fields}


def profile_names() -> list[str]:
    """List the profiles that ``load_profile`` finds by name."""
    return sorted(_find_profiles())


def load_profile(name_or_path: str | os.PathLike[str]) -> Profile:
    """Read a profile by its name or another name of it, or from a YAML file of the user.

    Directories named in ``VLATOOL_PROFILES`` (separated by ``:``) come before the profiles that are shipped.

    Raises:
        ProfileError: when there is no such profile, or with one line for each thing that is wrong in it.

    Example:
        >>> load_profile("raspberry-pi-5").units["cpu"].cores.value
        4.0
    """
    path = profile_file(os.fspath(name_or_path))
    data = read_mapping(path, f"The profile {path}", ProfileError)
    try:
        return Profile.model_validate(data)
    except ValidationError as error:
        problems = [describe_problem(item, KEYS) for item in error.errors(include_url=False)]
    except ProfileError as error:  # from the checks between fields; pydantic lets foreign exceptions through
        problems = error.message.splitlines()
    listed = "\n".join(f"  {problem}" for problem in problems)
    raise ProfileError(f"The profile {path} is malformed:\n{listed}", "correct these lines of the file")


def copy_profile(like: str, name: str, target: Path, *, force: bool = False) -> None:
    """Write another profile's text under a new name.

    Raises:
        ProfileError: when there is no such profile, or the name is not one.
        OutputError: when the file exists and ``force`` is not given, was changed by hand, or cannot be written.
    """
    load_profile(like)
    path = profile_file(like)
    if not re.fullmatch(NAME, name):
        raise ProfileError(
            f"'{name}' is not a valid profile name; allowed: lower-case letters, digits and hyphens.",
            "name it like my-robot-2",
        )
    text = re.sub(r"(?m)^name: .*$", f"name: {name}", remove_stamp(path.read_text(encoding="utf-8")), count=1)
    text = re.sub(r"(?m)^aliases:.*\n(?:[ \t]+.*\n|- .*\n|\]\n)*", "", text, count=1)
    try:
        write_own_file(target, text, force=force)
    except OSError as error:
        raise OutputError(
            f"{target} cannot be written: {error.strerror}.",
            "name another file with -o, or make its directory writable",
        ) from error


def profile_file(wanted: str) -> Path:
    """Return the file of a profile: a path, a name, or another name that a profile has.

    Raises:
        ProfileError: when there is none; names the nearest board, by whatever name of it.
    """
    if wanted.endswith(SUFFIXES) or os.sep in wanted:
        return Path(wanted)
    files = _find_profiles()
    if wanted in files:
        return files[wanted]
    typed = re.sub(r"[\s_]+", "-", wanted.strip().lower())
    boards = {**_aliases(files), **{name: name for name in files}}
    if typed in boards:
        return files[boards[typed]]
    near = difflib.get_close_matches(typed, boards, n=1)
    listing = f"known: {', '.join(sorted(files))}"
    fix = f"name one of these or a YAML file, or add a directory to {SEARCH_PATH}"
    hint = f"did you mean '{boards[near[0]]}'? {listing}" if near else listing
    raise ProfileError(f"Unknown profile '{wanted}'; {hint}.", fix)


def _aliases(files: Mapping[str, Path]) -> dict[str, str]:
    """Return other name -> name of a profile; files that cannot be read have none."""
    known: dict[str, str] = {}
    for name, path in files.items():
        with contextlib.suppress(ProfileError):
            listed = read_mapping(path, f"The profile {path}", ProfileError).get("aliases")
            known |= {str(alias): name for alias in listed if alias not in known} if isinstance(listed, list) else {}
    return known


def _folder(entry: EntryPoint) -> Path | None:
    """Return the folder of a package that another distribution brings profiles in."""
    spec = importlib.util.find_spec(entry.module)
    places = spec.submodule_search_locations if spec else None
    return Path(next(iter(places))) if places else None


def _find_profiles() -> dict[str, Path]:
    """Profile name -> file; the first directory that has it wins."""
    package = Path(__file__).resolve().parents[1]
    shipped = next((folder for folder in (package / "_profiles", package.parent / "profiles") if folder.is_dir()), None)
    own = [Path(entry) for entry in os.environ.get(SEARCH_PATH, "").split(os.pathsep) if entry]
    brought = [_folder(entry) for entry in registry.plugins("profiles").values()]
    files = [
        path for folder in (*own, shipped, *brought) if folder and folder.is_dir() for path in sorted(folder.iterdir())
    ]
    return {path.stem: path for path in reversed(files) if path.suffix in SUFFIXES}
