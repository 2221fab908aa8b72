"""Deployment: a bundle is checked, copied into the slot that is not active, tried there, and made active at once."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.deployment.judge import check_contract, inference_period_ms
from vlatool.deployment.pointer import MAX_COUNT, Pointer, Slot, Trial
from vlatool.deployment.shadow import MAX_RUNS, shadow_run
from vlatool.deployment.signature import verify
from vlatool.deployment.store import Store
from vlatool.errors import DeploymentError, GraphError, OutputError, SignatureError, UsageError, VlatoolError
from vlatool.runtime.arguments import MOST_THREADS, check_positive, check_whole
from vlatool.runtime.identity import policy_identity
from vlatool.runtime.policy import FIRST_RUN_S, refuse_findings
from vlatool.runtime.probe import probe

OnProgress = Callable[[str, float | None], None]
DOTTED_NUMBERS = re.compile(r"v?(\d{1,9}(?:\.\d{1,9}){0,5})(?![\d.])")
HASH_CHARACTERS = 19
"""Characters of a hash by which a downgrade is asked for: ``sha256:`` and twelve digits."""
SLACK_BYTES = 8 << 20
MAX_SECONDS, MAX_MS, MAX_MB = 1e6, 1e7, 1e6
"""Largest limits: 11 days, three hours for one inference, and 1 TB. More is a typing error."""
MAX_NAME = 200
"""Characters of a name or version that the pointer holds."""


@dataclass(frozen=True)
class Conditions:
    """What a bundle must pass before it is active, and until it is committed.

    Args:
        key: public key as hex that must have signed it; a new store then always requires it. None is needed when empty.
        downgrade_to: beginning of the hash of a bundle that is older than what was deployed; none when empty.
        new_contract: whether inputs, action and rates may differ from those of the active bundle.
        recording: observations of the shadow run, ``.npz``; the golden ones when empty.
        runs: inferences of the shadow run.
        latency_ms: limit on an inference in ms, in the shadow run and in the trial; when None, the time between two
            inferences at the control rate of the spec; 0 for no limit.
        memory_mb: limit on the growth of the process in 10^6 bytes, in the shadow run and in the trial; 0 for none.
        first_run_s: seconds that one inference of probe and shadow run may take.
        ticks: inferences of the trial.
        seconds: seconds of the trial.
        engine: engine that the robot uses; the one of the bundle when empty.
        threads: threads of the engine; the cores that this process may use when None.

    Raises:
        UsageError: when a number is out of its range.
    """

    key: str = ""
    downgrade_to: str = ""
    new_contract: bool = False
    recording: str = ""
    runs: int = 100
    latency_ms: float | None = None
    memory_mb: float = 256.0
    first_run_s: float = FIRST_RUN_S
    ticks: int = 1000
    seconds: float = 60.0
    engine: str = ""
    threads: int | None = None

    def __post_init__(self) -> None:
        check_whole("runs", self.runs, 1, MAX_RUNS)
        check_whole("ticks", self.ticks, 0, MAX_COUNT - 1)
        check_whole("threads", self.threads, 1, MOST_THREADS, optional=True)
        for name, most, unit in (
            ("latency_ms", MAX_MS, "milliseconds"), ("first_run_s", MAX_SECONDS, "seconds"),
            ("seconds", MAX_SECONDS, "seconds"), ("memory_mb", MAX_MB, "10^6 bytes"),
        ):  # fmt: skip
            value = getattr(self, name)
            words = f"a number of {unit} up to {most:g},"
            check_positive(name, value, words, optional=name == "latency_ms", zero=name != "first_run_s")
            if value is not None and value > most:
                raise UsageError(f"{name} is {value!r}; allowed: {words[:-1]}.", "pass a smaller one")


def deploy(store: Store, path: Path, conditions: Conditions, tell: OnProgress) -> dict[str, Any]:
    """Deploy a bundle, and return the status of the store with what the shadow run measured.

    Whatever fails, and at whatever instant this process ends, the active slot stays as it was. From the moment that the
    copy begins, the bundle before the active one is gone; or one on trial that no controller has opened, and the one
    before it is active.

    Raises:
        BundleError, SpecError, DataError: when the bundle is damaged, has another contract, or nothing to run on.
        SignatureError: when its signature is missing, or not by a key that the store requires.
        DeploymentError: when it is older than what was deployed, a trial is running, or the store cannot be read.
        GraphError, GateFailed: when it fails the probe or the shadow run.
        OutputError: when the store cannot be written.
        MissingExtra: when the engine is missing, or ``cryptography`` where a signature is required.
    """
    tell("verifying the bundle", None)
    bundle = Bundle.open(path)
    refuse_findings(bundle)
    store.make()
    with store.lock() as pointer:
        on_disk, pointer = pointer, _after_idle_trial(store, pointer)
        if pointer.current is not None and pointer.current.bundle == bundle.hash:
            which = "the active bundle already" if pointer == on_disk else "the bundle before the one on trial"
            raise DeploymentError(f"{path} is {which}.", "vlatool status shows what is deployed; or: vlatool rollback")
        keys = _required_keys(pointer, conditions.key)
        signature = verify(bundle, keys) if keys else None
        release = signature.release if signature else 0
        _refuse_older(pointer, bundle, release, conditions.downgrade_to)
        _check_against_active(store, pointer, bundle, conditions)
        _refuse_own_slot(store, pointer, path)
        _check_room(store, pointer, bundle)
        tell(f"copying it into slot {pointer.inactive}", None)
        pointer = pointer if pointer == on_disk else store.write(pointer)
        pointer, copy = store.fill(pointer, bundle)
        measured = _try_out(copy, conditions, tell)
        names = (bundle.manifest.name[:MAX_NAME], bundle.manifest.version[:MAX_NAME])
        slot = Slot(copy.hash, policy_identity(copy), *names, release, signature.key if signature else "")
        pointer = store.activate(_highest(replace(pointer, keys=keys), slot), slot, _trial(copy, conditions))
    return {**status(store, pointer), "shadow": measured}


def status(store: Store, pointer: Pointer) -> dict[str, Any]:
    """Return the state of a store as JSON values; ``problem`` says what is wrong with the files of a slot."""
    slots = {}
    for name, slot in pointer.slots.items():
        slots[name] = {**asdict(slot), "problem": _problem(store, name, slot)}
    return {
        "store": str(store.path), "active": pointer.active, "slots": slots, "change": pointer.change,
        "trial": None if pointer.trial is None else asdict(pointer.trial),
        "highest_release": pointer.highest_release, "highest_version": pointer.highest_version,
        "required_keys": list(pointer.keys), "last_rollback": pointer.rollback,
    }  # fmt: skip


def roll_back(store: Store, reason: str = "an operator asked for it") -> dict[str, Any]:
    """Go back to the other slot after its files were verified, and return the status.

    Raises:
        DeploymentError: when there is no other bundle, or it is damaged.
    """
    with store.lock() as pointer:
        changed = store.pointer_after_rollback(pointer, reason)
        if problem := _problem(store, pointer.inactive, pointer.slots[pointer.inactive]):
            raise DeploymentError(
                f"The bundle to go back to is damaged: {problem}", "deploy a whole one: vlatool deploy BUNDLE"
            )
        changed = store.write(changed)
    return status(store, changed)


def open_slot(store: Store, name: str, slot: Slot) -> Bundle:
    """Open the bundle of a slot, its files not yet verified; raises DeploymentError when it is another one."""
    bundle = Bundle.open_lazily(store.folder(name))
    check_same(bundle, slot)
    return bundle


def check_same(bundle: Bundle, slot: Slot) -> None:
    """Refuse a bundle that is not the one in the pointer; raises DeploymentError."""
    if bundle.hash != slot.bundle:
        raise DeploymentError(
            f"{bundle.path} holds another bundle ({bundle.hash[:HASH_CHARACTERS]}) than was deployed "
            f"({slot.bundle[:HASH_CHARACTERS]}).", "deploy it: only vlatool deploy writes into a store",
        )  # fmt: skip


def _problem(store: Store, name: str, slot: Slot) -> str:
    try:
        open_slot(store, name, slot).verify()
    except VlatoolError as error:
        return error.message
    return ""


def _after_idle_trial(store: Store, pointer: Pointer) -> Pointer:
    """Return the pointer, of a trial that no controller has begun the one before it; refuse where one has begun.

    Where the files of the one before are damaged, nothing could be gone back to: the one on trial stays active.
    """
    if pointer.trial is None:
        return pointer
    if pointer.trial.starts:
        raise DeploymentError(
            f"The store {store.path} has a bundle on trial.", "wait until it is committed, or: vlatool rollback"
        )
    if _problem(store, pointer.inactive, pointer.slots[pointer.inactive]):
        return pointer.without_inactive()
    return pointer.exchange("another bundle was deployed before its trial began")


def _required_keys(pointer: Pointer, key: str) -> tuple[str, ...]:
    """Return the keys of which one must have signed a bundle: those of the store, and the one that was named."""
    if not key:
        return pointer.keys
    if pointer.keys and key not in pointer.keys:
        raise SignatureError(
            f"The store requires another key ({pointer.keys[0][:16]}) than {key[:16]}.",
            "leave --key out, or deploy into another store",
        )
    return (key,)


def _refuse_older(pointer: Pointer, bundle: Bundle, release: int, named: str) -> None:
    """Refuse a bundle that is older than one that was deployed, unless it is named by its hash, and one not named."""
    if len(named) >= HASH_CHARACTERS and bundle.hash.startswith(named):
        return
    why = _older(pointer, bundle, release)
    if not why and named:
        raise DeploymentError(f"{bundle.path} is not {named}, which --downgrade-to names, but {bundle.hash}.",
                              "leave --downgrade-to out, or deploy the bundle that it names")  # fmt: skip
    if not why:
        return
    raise DeploymentError(
        f"{bundle.path} {why}.",
        f"deploy a newer one; or, to go back on purpose: --downgrade-to {bundle.hash[:HASH_CHARACTERS]}",
    )


def _older(pointer: Pointer, bundle: Bundle, release: int) -> str:
    if pointer.highest_release and release < pointer.highest_release:
        return f"has release {release}, older than release {pointer.highest_release}, which was deployed"
    if release and release == pointer.highest_release and bundle.hash != pointer.highest_bundle:
        return f"has release {release}, as another bundle that was deployed"
    new, old = _dotted(bundle.manifest.version), _dotted(pointer.highest_version)
    if new is not None and old is not None and new < old:
        return f"has version {bundle.manifest.version}, older than {pointer.highest_version}, which was deployed"
    return ""


def _dotted(version: str) -> tuple[int, ...] | None:
    """Return the numbers of a version such as 1.2.0, without zeros at its end; None for any other text.

    Example:
        >>> _dotted("v1.10"), _dotted("1.9.0"), _dotted("main")
        ((1, 10), (1, 9), None)
    """
    found = DOTTED_NUMBERS.match(version)
    if found is None:
        return None
    numbers = [int(part) for part in found[1].split(".")]
    while numbers and not numbers[-1]:
        numbers.pop()
    return tuple(numbers)


def _highest(pointer: Pointer, slot: Slot) -> Pointer:
    """Return the pointer with the highest release and version that were deployed, this slot's among them."""
    new, old = _dotted(slot.version), _dotted(pointer.highest_version)
    if new is not None and (old is None or new > old):
        pointer = replace(pointer, highest_version=slot.version)
    if slot.release > pointer.highest_release:
        pointer = replace(pointer, highest_release=slot.release, highest_bundle=slot.bundle)
    return pointer


def _check_against_active(store: Store, pointer: Pointer, bundle: Bundle, conditions: Conditions) -> None:
    """Refuse another contract than that of the active bundle; one that is damaged has none to compare with."""
    if pointer.current is None or conditions.new_contract:
        return
    try:
        active = open_slot(store, pointer.active, pointer.current)
    except VlatoolError:
        return
    check_contract(bundle.manifest.spec, active.manifest.spec)


def _refuse_own_slot(store: Store, pointer: Pointer, path: Path) -> None:
    """Refuse to copy from the slot that is emptied for the copy; raises DeploymentError."""
    slot, source = store.folder(pointer.inactive).resolve(), path.resolve()
    if slot == source or slot in source.parents or source in slot.parents:
        raise DeploymentError(
            f"{path} is in the slot that it would be copied into.",
            "copy it to another directory first; or, to go back to it: vlatool rollback",
        )


def _check_room(store: Store, pointer: Pointer, bundle: Bundle) -> None:
    """Refuse a bundle that does not fit on the disk, before the other slot is emptied for it."""
    old = store.folder(pointer.inactive)
    freed = sum(file.lstat().st_size for file in old.rglob("*") if not file.is_dir()) if old.is_dir() else 0
    free = shutil.disk_usage(store.path).free + freed
    needed = bundle.size_bytes + SLACK_BYTES
    if needed > free:
        raise OutputError(
            f"The disk of the store {store.path} is too full: {needed / 1e6:.1f} MB are needed, "
            f"{free / 1e6:.1f} MB are free.",
            "free some space, or name another directory with --store",
        )


def _try_out(copy: Bundle, conditions: Conditions, tell: OnProgress) -> dict[str, Any]:
    """Probe the copy and let it answer observations, each in a child process; return what was measured."""
    tell("running it once in a child process", None)
    common: dict[str, Any] = {name: getattr(conditions, name) for name in ("engine", "threads", "first_run_s")}
    tried = probe(copy.path, **common)
    if tried["refused"]:
        raise GraphError(*tried["refused"])
    tell("shadow run on recorded observations", None)
    latency = latency_limit(copy, conditions)
    recording = Path(conditions.recording) if conditions.recording else None
    return shadow_run(copy.path, recording=recording, runs=conditions.runs, latency_ms=latency,
                      growth_mb=conditions.memory_mb, **common)  # fmt: skip


def latency_limit(bundle: Bundle, conditions: Conditions) -> float:
    """Return the limit on an inference in ms: the one in the conditions, else by the control rate; 0 for none."""
    return inference_period_ms(bundle.manifest.spec) if conditions.latency_ms is None else conditions.latency_ms


def _trial(copy: Bundle, conditions: Conditions) -> Trial:
    return Trial(conditions.ticks, conditions.seconds, latency_limit(copy, conditions), conditions.memory_mb)
