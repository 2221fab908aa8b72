"""Training data from a function of the user: ``training: train.py:batches`` in policy.yaml.

The function is user code, as an environment is: it runs in a child process, which writes what it yields.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.errors import DataError, RecipeError
from vlatool.files.printable import amount, message_of
from vlatool.module.factory import iterate_function
from vlatool.module.origin import origin_of
from vlatool.runtime.observation import ObservationEncoder
from vlatool.stage.base import Context
from vlatool.training.frames import begins_file
from vlatool.training.rounds import write_observations
from vlatool.user_code.children import OnProgress, call

MODULE = "vlatool.training.user_batches"
PRELOAD = ("numpy", MODULE)
DEFAULT_ROWS = 8192
"""Default number of rows."""
EPISODE = "episode"
"""Name of the episode numbers in a batch whose rows are steps; where the number changes, the policy is reset."""
MAX_BATCH_ROWS = 256
"""Rows of a batch that the function is asked for, at most."""
GUIDE = "docs/guides/your-own-policy.md shows one"


def requested_rows(asked: int | None, source: Bundle, plays: bool) -> int:
    """Return how many rows are taken from the policy's function.

    Args:
        asked: number that the user asked for; None when not given.
        plays: whether the teacher plays episodes: then none are taken unless they are asked for.

    Raises:
        RecipeError: when rows are asked for, and the policy's description names no function.
    """
    named = origin_of(source).training
    if asked and not named:
        raise RecipeError(
            f"--from-batches takes rows from the function that policy.yaml names under 'training'; that of "
            f"{source.manifest.name} names none.",
            "add training: train.py:batches to it, or leave --from-batches out",
        )
    return (DEFAULT_ROWS if named and not plays else 0) if asked is None else asked


def write_user_batches(
    source: Bundle, count: int, seed: int, target: Path, context: Context, *, along: bool = False
) -> None:
    """Write encoded observations that the policy's function yields, as a part of a round.

    Args:
        seed: seed that the function is called with.
        target: folder for ``NAME.npy`` of each input, (count, ...).
        along: whether rows are episodes, which the batches number under ``episode``.

    Raises:
        DataError: when it yields something else than batches of observations, or too few.
        SourceError: when it fails, ends its process, or may not run.
    """
    paths = {"source": str(source.path.absolute()), "target": str(target.absolute())}
    job = {**paths, "count": count, "seed": seed, "along": along}
    call(f"{MODULE}:write", job, context.progress, origin_of(source).training.rpartition(":")[0], PRELOAD)


def write(job: Mapping[str, Any], tell: OnProgress) -> None:
    """Do what ``write_user_batches`` says, in this process."""
    source = Bundle.open(Path(job["source"]), verify=False)
    origin = origin_of(source)
    origin.check((".py",))
    size = min(MAX_BATCH_ROWS, job["count"])
    batches = iterate_function(origin.training, origin.folder, {"seed": job["seed"], "size": size})
    encode = ObservationEncoder(source.manifest.spec, source)
    names = [*encode.names, *([EPISODE] if job["along"] else [])]
    rows = _Rows(batches, origin.training, encode, job["count"], size, tell, names)
    write_observations(rows.encode, rows, Path(job["target"]))
    if job["along"]:
        np.save(begins_file(Path(job["target"])), np.diff(rows.episodes, prepend=rows.episodes[0] - 1) != 0)


@dataclass
class _Rows:
    """The rows of batches, one after the other.

    Args:
        function: its name, for messages.
        size: rows of a batch, at most.
        names: what a batch holds: the inputs, and ``episode`` where it numbers the episode of each row.
    """

    batches: Iterator[Any]
    function: str
    encoder: ObservationEncoder
    count: int
    size: int
    tell: OnProgress
    names: Sequence[str]
    episodes: list[int] = field(default_factory=list)
    _row: str = ""

    def __len__(self) -> int:
        return self.count

    def __iter__(self) -> Iterator[Mapping[str, Any]]:
        done = 0
        for number, batch in enumerate(self.batches, 1):
            columns = self._columns(f"{number} of '{self.function}'", batch)
            for row in range(min(len(next(iter(columns.values()))), self.count - done)):
                self.episodes += [int(columns[EPISODE][row])] if EPISODE in self.names else []
                self._row = f"Row {row} of batch {number} of '{self.function}'"
                yield {name: column[row] for name, column in columns.items()}
                done += 1
            self.tell(f"{done} of {amount(self.count, 'row')} of {self.function}", done / self.count)
            if done == self.count:
                return
        if not done:
            raise DataError(
                f"'{self.function}' yields nothing; wanted {amount(self.count, 'row')}.", f"let it yield; {GUIDE}"
            )
        raise DataError(
            f"'{self.function}' ends after {amount(done, 'row')}; wanted {self.count}.",
            f"let it go on, or take fewer: --from-batches {done}",
        )

    def encode(self, observation: Mapping[str, Any]) -> dict[str, Any]:
        """Return what the policy is given of the last row; raises DataError when it is not what the policy takes."""
        try:
            return self.encoder(observation)
        except DataError as error:
            raise DataError(f"{self._row}: {error.message}", error.fix) from error

    def _columns(self, name: str, batch: Any) -> dict[str, Any]:
        """Return the inputs of a batch, each with a row for each observation."""
        takes = f"the policy takes {', '.join(self.encoder.names)}."
        if EPISODE in self.names and isinstance(batch, Mapping) and EPISODE not in batch:
            raise DataError(
                f"Batch {name} has no '{EPISODE}', and the policy keeps values from step to step: rows are steps of "
                "episodes.",
                f"yield the rows of an episode one after the other, each with the number of its episode: '{EPISODE}'",
            )
        if not isinstance(batch, Mapping):
            raise DataError(
                f"Batch {name} is a {type(batch).__name__}; it must be a mapping of names to arrays: {takes}", GUIDE
            )
        if missing := [key for key in self.names if key not in batch]:
            has = ", ".join(map(str, batch)) or "nothing"
            raise DataError(f"Batch {name} has no '{missing[0]}' (it has: {has}); {takes}", GUIDE)
        columns = {key: _array(f"'{key}' in batch {name}", batch[key]) for key in self.names}
        if EPISODE in columns and (columns[EPISODE].ndim != 1 or columns[EPISODE].dtype.kind not in "iu"):
            got = f"{columns[EPISODE].dtype} {list(columns[EPISODE].shape)}"
            raise DataError(f"'{EPISODE}' in batch {name} is {got}; wanted a whole number for each row.", GUIDE)
        rows = {key: len(column) for key, column in columns.items()}
        if len(set(rows.values())) > 1:
            sizes = ", ".join(f"{key} {count}" for key, count in rows.items())
            raise DataError(
                f"Batch {name} has different numbers of rows: {sizes}.", "each input needs a row an observation"
            )
        if not 1 <= (count := next(iter(rows.values()))) <= self.size:
            raise DataError(
                f"Batch {name} has {count} rows; allowed: 1 to {self.size}, the 'size' that it was asked for.",
                "yield batches of 'size' rows or fewer, and none that is empty",
            )
        return columns


def _array(what: str, value: Any) -> Any:
    """Return an array with rows."""
    try:
        array = np.asarray(value)
    except Exception as error:  # the seam: numpy asks the object for an array
        raise DataError(
            f"{what} is a {type(value).__name__}, which cannot be converted to a numpy array: "
            f"{(message_of(error).splitlines() or [''])[0]}.",
            "yield numpy arrays; tensors as tensor.numpy()",
        ) from error
    if not array.ndim:
        raise DataError(f"{what} is a single value; wanted a row for each observation.", GUIDE)
    return array
