"""A gate: the claims that a candidate must keep to beside a baseline, as YAML that a repository keeps."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import ConfigDict, Field, ValidationError, create_model, model_validator
from pydantic_core import ErrorDetails

from vlatool import registry
from vlatool.errors import PluginError, RecipeError, VlatoolError, require, suggest
from vlatool.files.numbers import Numeric
from vlatool.files.printable import reason_of
from vlatool.files.yaml import read_mapping
from vlatool.gate.claim import KIND, Claim
from vlatool.gate.plan import Need, Plan


class _Gate(Numeric):
    """Everything that a candidate must keep to; a claim that is null is not examined."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    schema_: int = Field(1, alias="schema", ge=1, le=1)
    baseline: Path | None = Field(None, description="bundle to compare with; --baseline goes before it")
    accept: tuple[str, ...] = Field((), description="findings of the bundles that are overruled, by name")

    @property
    def claims(self) -> dict[str, Claim]:
        """The claims that are not null by name, in the order of a gate file."""
        named = {name: getattr(self, name) for name in claim_classes()}
        return {name: claim for name, claim in named.items() if claim is not None}

    @property
    def plan(self) -> Plan:
        """The measurements for all claims together."""
        return functools.reduce(lambda plan, claim: claim.extend_plan(plan), self.claims.values(), Plan())

    @property
    def in_order(self) -> list[Claim]:
        """The claims in the order in which they are examined: what is cheap first."""
        return sorted(self.claims.values(), key=lambda claim: max(claim.needs, default=0))

    @property
    def paths(self) -> list[Path]:
        """The files and folders that the claims name."""
        return [path for claim in self.claims.values() for path in claim.paths.values()]

    def with_options(self, claim: str, **options: Any) -> Gate:
        """Return the gate with other options of a claim, which is examined then."""
        known = self.claims.get(claim) or claim_classes()[claim]()
        return self.model_copy(update={claim: known.model_copy(update=options)})

    def with_paths_in(self, folder: Path) -> Gate:
        """Return the gate with paths that are relative to a folder."""
        claims = {name: claim.model_copy(update={option: folder / path for option, path in claim.paths.items()})
                  for name, claim in self.claims.items()}  # fmt: skip
        return self.model_copy(update={**claims, "baseline": self.baseline and folder / self.baseline})

    @model_validator(mode="after")
    def _something_is_claimed(self) -> _Gate:
        if all(Need.EPISODES in claim.needs for claim in self.claims.values()):
            raise ValueError("every claim is null, so there is nothing to examine")
        return self

    @model_validator(mode="after")
    def _episodes_are_played(self) -> _Gate:
        named = [name for name, claim in self.claims.items() if Need.EPISODES in claim.needs]
        if named and not self.plan.episodes:
            raise ValueError(f"{', '.join(named)} is claimed of closed-loop episodes; name them (accuracy: episodes)")
        return self

    def to_yaml(self) -> str:
        """Return YAML that ``read_gate`` turns back into an equal gate."""
        yaml = require("yaml", "build")
        text: str = yaml.safe_dump(self.model_dump(mode="json", by_alias=True), sort_keys=False)
        return text


@functools.cache
def claim_classes() -> Mapping[str, type[Claim]]:
    """Return name -> claim, in the order of a gate file; those of other packages that cannot be loaded are left out.

    Such a claim is an error where a gate file names it (``read_gate``), and elsewhere in nobody's way.
    """
    classes: dict[str, type[Claim]] = {}
    for name in registry.names(KIND):
        with contextlib.suppress(VlatoolError):
            classes[name] = _claim_class(name)
    return dict(sorted(classes.items(), key=lambda item: item[1].order))


def _claim_class(name: str) -> type[Claim]:
    found = registry.load(KIND, name)
    if not issubclass(found, Claim):
        raise PluginError(f"The claim '{name}' is not a subclass of vlatool.gate.claim.Claim.", "derive it from that")
    return found


def _default(name: str, claim: type[Claim]) -> Claim | None:
    """Return the claim where it is not named: one of another package is examined only where a gate file names it."""
    return claim() if claim.by_default and name not in registry.plugins(KIND) else None


if TYPE_CHECKING:
    Gate = _Gate
else:
    SECTIONS = {name: (claim | None, _default(name, claim)) for name, claim in claim_classes().items()}
    Gate = create_model("Gate", __base__=_Gate, __module__=__name__, __doc__=_Gate.__doc__, **SECTIONS)


def _problem(error: ErrorDetails) -> str:
    """Return one problem in a sentence; what was got is shown where it is one value."""
    path, got = error["loc"], error["input"]
    key = ".".join(map(str, path))
    if error["type"] == "extra_forbidden":
        fields = claim_classes()[str(path[0])].model_fields if path[1:] else Gate.model_fields
        known = [field.alias or name for name, field in fields.items()]
        return f"{key}: is not a known key; {suggest(str(path[-1]), known)}"
    shown = f" (got {got!r})" if key and isinstance(got, str | int | float) else ""
    return f"{key or 'gate'}: {reason_of(error['msg'])}{shown}"


def _fix(error: ValidationError) -> str:
    """Return what to write instead; a percentage is what people write who know --max-drop 1%."""
    shares = [item for item in error.errors() if str(item["input"]).strip().endswith("%")]
    share = "write a share as a number: 0.05 is 5 %; " if shares else ""
    return f"{share}docs/reference/gate.md says what each key takes"


def read_gate(path: Path) -> Gate:
    """Read a gate file; paths in it are relative to its directory.

    Raises:
        RecipeError: when the file is missing, is not YAML, or says something impossible; lists every problem.
        PluginError: when it names a claim of another package that cannot be loaded.
    """
    if not path.exists():
        raise RecipeError(f"There is no gate {path}.", "write one: vlatool gate init")
    data = read_mapping(path, f"The gate {path}", RecipeError)
    for name in registry.plugins(KIND).keys() & data.keys():
        _claim_class(name)
    try:
        return Gate.model_validate(data).with_paths_in(path.parent)
    except ValidationError as error:
        problems = map(_problem, error.errors())
        raise RecipeError(f"The gate {path}: {'; '.join(problems)}.", _fix(error)) from error
