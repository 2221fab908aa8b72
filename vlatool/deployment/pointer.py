"""The pointer of a store: which slot is active, what each holds, and what must not be undone.

It is one small file that is replaced at once, with a copy for the case that the first one decays. Only one text is
valid for a pointer, and it holds its own SHA-256: any other content is refused.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from vlatool.errors import DeploymentError
from vlatool.files.durable import replace_file
from vlatool.files.json import parse_json
from vlatool.files.messages import from_json, to_json
from vlatool.files.verified_read import open_regular, read_all

SCHEMA = 1
NAMES = ("a", "b")
"""Names of the slots, which are directories of the store."""
FILES = ("pointer.json", "pointer.copy.json")
MAX_BYTES = 1 << 16
HASH = re.compile(r"sha256:[0-9a-f]{64}")
KEY = re.compile(r"[0-9a-f]{64}")
MAX_COUNT = 2**53
REPAIR = "deploy again into another store (--store), and open that one on the robot"


@dataclass(frozen=True)
class Slot:
    """What a slot holds.

    Args:
        bundle: ``sha256:...`` of the bundle, which covers each of its files.
        identity: ``sha256:...`` of the policy, see ``vlatool.runtime.identity``.
        name: name of the policy.
        version: version of the policy, as its author assigned it.
        release: number that its signature gives it; 0 without a signature.
        key: public key that signed it, as hex; empty without a signature.
    """

    bundle: str
    identity: str
    name: str
    version: str
    release: int = 0
    key: str = ""

    def __post_init__(self) -> None:
        if not HASH.fullmatch(self.bundle) or not HASH.fullmatch(self.identity):
            raise ValueError("a slot has a hash that is not sha256: and 64 hex digits")
        _check_count("release", self.release)
        if self.key and not KEY.fullmatch(self.key):
            raise ValueError("the key of a slot is not 64 hex digits")


@dataclass(frozen=True)
class Trial:
    """Conditions under which the active slot is committed; until then it can be rolled back without an operator.

    Args:
        ticks: inferences that it must answer.
        seconds: seconds for which it must run.
        latency_ms: limit on an inference in ms; 0 for none.
        memory_mb: limit on the growth of the process in 10^6 bytes.
        starts: times that a process has opened it and not closed it in an orderly way.
    """

    ticks: int
    seconds: float
    latency_ms: float
    memory_mb: float
    starts: int = 0

    def __post_init__(self) -> None:
        for name in ("ticks", "starts"):
            _check_count(name, getattr(self, name))
        for name in ("seconds", "latency_ms", "memory_mb"):
            object.__setattr__(self, name, float(getattr(self, name)))  # one text for one number
            if not 0 <= getattr(self, name) < MAX_COUNT:
                raise ValueError(f"{name} of the trial is out of range")


@dataclass(frozen=True)
class Pointer:
    """State of a store.

    Args:
        change: number of changes of this pointer.
        active: name of the active slot; empty in a new store.
        slots: what the slots hold that a robot may start with.
        trial: conditions of the active slot's trial; None when it is committed.
        highest_release: highest number of a signature that was ever deployed.
        highest_bundle: hash of the bundle with that number.
        highest_version: highest version that was ever deployed.
        keys: public keys, as hex, of which one must have signed a bundle; none is needed when empty.
        rollback: reason of the last rollback.
    """

    schema: int = SCHEMA
    change: int = 0
    active: str = ""
    slots: dict[str, Slot] = field(default_factory=dict)
    trial: Trial | None = None
    highest_release: int = 0
    highest_bundle: str = ""
    highest_version: str = ""
    keys: tuple[str, ...] = ()
    rollback: str = ""

    def __post_init__(self) -> None:
        if self.schema != SCHEMA:
            raise ValueError(f"it has the schema {self.schema}; this vlatool reads {SCHEMA}")
        for name in ("change", "highest_release"):
            _check_count(name, getattr(self, name))
        if not set(self.slots) <= set(NAMES) or (self.active not in self.slots and (self.active or self.slots)):
            raise ValueError("its active slot is not one that it has")
        if self.trial is not None and len(self.slots) < len(NAMES):
            raise ValueError("it has a trial, and nothing to go back to")
        if not all(KEY.fullmatch(key) for key in self.keys):
            raise ValueError("a key is not 64 hex digits")

    @property
    def inactive(self) -> str:
        """Name of the slot that is not active."""
        return NAMES[self.active == NAMES[0]]

    @property
    def current(self) -> Slot | None:
        """What the active slot holds; None in a new store."""
        return self.slots.get(self.active)

    def without_inactive(self) -> Pointer:
        """Return the pointer that holds the active slot alone, which is then committed."""
        slots = {name: slot for name, slot in self.slots.items() if name == self.active}
        return replace(self, slots=slots, trial=None)

    def exchange(self, reason: str) -> Pointer:
        """Return the pointer after a rollback to the other slot; a slot whose trial ends so is dropped."""
        swapped = replace(self, active=self.inactive, trial=None, rollback=reason[:500])
        return swapped if self.trial is None else swapped.without_inactive()


def encode(pointer: Pointer) -> bytes:
    """Return the only valid content of the file of a pointer.

    Fields that have their default are left out: a later vlatool that has more of them reads this store, too.
    """
    plain = {"schema": pointer.schema, **to_json(pointer, defaults=False)}
    digest = hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()
    return (json.dumps({"pointer": plain, "sha256": digest}, indent=1) + "\n").encode()


def decode(content: bytes) -> Pointer:
    """Return the pointer of a file; raises ValueError, with a short reason, for what ``encode`` does not write."""
    if len(content) > MAX_BYTES:
        raise ValueError(f"it has more than {MAX_BYTES} bytes")
    data: Any = parse_json(content, strict=True)
    if not isinstance(data, dict) or set(data) != {"pointer", "sha256"}:
        raise ValueError("it is not a pointer")
    pointer = from_json(Pointer, data["pointer"], "pointer")
    if encode(pointer) != content:
        raise ValueError("it was changed")
    return pointer


def read_pointer(store: Path) -> Pointer:
    """Return the pointer of a store: the first of both files that is whole; an empty one where there is neither.

    Raises:
        DeploymentError: when a file is there and neither is whole.
    """
    problems = []
    for name in FILES:
        try:
            with open_regular(store, name) as handle:
                return decode(read_all(handle, MAX_BYTES))
        except FileNotFoundError:
            continue
        except (OSError, ValueError) as error:
            problems.append(f"{name}: {error.strerror if isinstance(error, OSError) else error}")
    if problems:
        raise DeploymentError(f"The store {store} cannot be read; {'; '.join(problems)[:300]}.", REPAIR)
    return Pointer()


def write_pointer(store: Path, pointer: Pointer) -> Pointer:
    """Replace the copy of the pointer and then the pointer, each at once, and return it with the next number.

    Raises:
        OSError: when one of both cannot be written; the old pointer then holds.
    """
    numbered = replace(pointer, change=pointer.change + 1)
    pointer_file, copy = (store / name for name in FILES)
    replace_file(copy, encode(numbered))
    try:
        replace_file(pointer_file, encode(numbered))
    except OSError:
        with contextlib.suppress(OSError):  # it says what has not happened
            copy.unlink()
        raise
    return numbered


def _check_count(name: str, value: int) -> None:
    if not 0 <= value < MAX_COUNT:
        raise ValueError(f"{name} is out of range")
