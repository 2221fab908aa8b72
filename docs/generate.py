"""Write ``docs/reference/`` from the code; ``--check`` fails when the pages and the code differ.

Usage: python docs/generate.py [--check]
"""

from __future__ import annotations

import dataclasses
import inspect
import json
import os
import re
import sys
import typing
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from vlatool import errors, measures, registry, report
from vlatool.bundle import image, manifest, prompt, spec
from vlatool.cli._schemas import COMMANDS, definitions
from vlatool.gate import config
from vlatool.hardware.profile import load_profile, profile_names
from vlatool.hardware.robots import robots_json, robots_page
from vlatool.runtime.envelope.limits import ROBOTS
from vlatool.stage.base import Stage
from vlatool.stage.build import stage_kinds

REFERENCE = Path(__file__).parent / "reference"
NOTE = "<!-- written by docs/generate.py from the code; do not edit -->\n"


def main() -> None:
    """Write the pages, or compare them with what the code says."""
    pages = {
        "stages.md": stages_page(),
        "command-line.md": command_line_page(),
        "manifest.md": fields_page("manifest.json", [
            manifest.Manifest, spec.PolicySpec, spec.TensorSpec, image.Image, image.ImageStep, prompt.Prompt,
            prompt.StateText, manifest.ProgramStep, manifest.Graph,
        ]),
        "report.md": report_page(),
        "measures.md": measures_page(),
        "errors.md": errors_page(),
        "profiles.md": profiles_page(),
        "robots.md": robots_page(),
        "gate.md": gate_page(),
        "json.md": json_page(),
    }  # fmt: skip
    pages = {name: NOTE + text for name, text in pages.items()}
    pages["report.schema.json"] = schema_page()
    pages["output.schema.json"] = output_schema_page()
    pages[os.path.relpath(ROBOTS, REFERENCE)] = robots_json()  # what a robot reads, as it has no YAML
    if "--check" not in sys.argv:
        REFERENCE.mkdir(exist_ok=True)
        for name, text in pages.items():
            (REFERENCE / name).write_text(text, encoding="utf-8")
        return
    stale = [name for name, text in pages.items() if _read(REFERENCE / name) != text]
    if stale:
        sys.exit(f"docs/reference differs from the code in {', '.join(stale)}; run: make docs")
    print(f"docs/reference equals the code ({len(pages)} pages)")


def stages_page() -> str:
    """Return a section for each stage: what it does and its options."""
    parts = ["# Stages\n\nEach is one file, `vlatool/<kind>/<name>.py`; a recipe names it `kind.name`.\n"]
    for kind in stage_kinds():
        for name in registry.names(kind):
            stage: type[Stage] = registry.load(kind, name)
            parts.append(f"## {stage.name()}\n\n{inspect.cleandoc(stage.__doc__ or '')}\n\n{_options(stage)}")
    return "\n".join(parts)


def gate_page() -> str:
    """Return a section for each claim of a gate file."""
    top = "What `vlatool gate` examines ([guide](../guides/gate.md)): `schema: 1`, `baseline: PATH`, and these claims;"
    classes = config.claim_classes()
    off = [f"`{name}`" for name, claim in classes.items() if not claim.by_default]
    parts = [f"# gate.yaml\n\n{top}\na claim that is null is not examined. Null by default: {', '.join(off)}.\n"]
    parts += [f"## {name}\n\n{inspect.cleandoc(claim.__doc__ or '')}\n\n{_options(claim)}"
              for name, claim in classes.items()]  # fmt: skip
    meaning = config.Gate.model_fields["accept"].description
    parts.append(f"## accept\n\n`accept: [engine-difference]`: {meaning}; see `vlatool inspect`. None by default.\n")
    return "\n".join(parts)


def _options(stage: type[BaseModel]) -> str:
    rows = ["| option | type | default | meaning |", "|---|---|---|---|"]
    for name, field in stage.model_fields.items():
        kind = str(field.annotation).replace("typing.", "").replace("pathlib._local.", "").replace("pathlib.", "")
        kind = kind.removeprefix("<class '").removesuffix("'>").replace("|", "or")
        default = "required" if field.is_required() else f"`{field.default!r}`"
        rows.append(f"| `{name}` | {kind} | {default} | {field.description or ''} |")
    return "\n".join(rows) + "\n"


def command_line_page() -> str:
    """Return the help of every command."""
    os.environ.update({"COLUMNS": "100", "TERMINAL_WIDTH": "100", "NO_COLOR": "1", "TERM": "dumb"})
    import typer
    from typer.testing import CliRunner

    from vlatool.cli import app

    command = typer.main.get_command(app)
    runner = CliRunner()
    parts = ["# Command line\n"]

    def visit(words: list[str], current: Any) -> None:
        text = runner.invoke(app, [*words, "--help"], prog_name="vlatool").output
        title = " ".join(["vlatool", *words])
        parts.append(f"## {title}\n\n```\n{text.strip()}\n```\n")
        lister = getattr(current, "list_commands", None)
        for name in lister(None) if lister else []:
            visit([*words, name], current.get_command(None, name))

    visit([], command)
    return "\n".join(parts)


def fields_page(title: str, classes: list[Any]) -> str:
    """Return a table of the fields of dataclasses, with their docstrings."""
    parts = [f"# {title}\n"]
    for kind in classes:
        text, meanings = _described(kind)
        rows = ["| key | type | default | meaning |", "|---|---|---|---|"]
        for field in dataclasses.fields(kind):
            default = "required"
            if field.default is not dataclasses.MISSING:
                default = f"`{field.default!r}`"
            elif field.default_factory is not dataclasses.MISSING:
                default = f"`{field.default_factory()!r}`"
            kind_of = str(field.type).replace("|", "or").replace("Number", "float")
            rows.append(f"| `{field.name}` | {kind_of} | {default} | {meanings.get(field.name, '')} |")
        parts.append(f"## {kind.__name__}\n\n{text}\n\n" + "\n".join(rows) + "\n")
    return "\n".join(parts)


def report_page() -> str:
    """Return the fields of a report, and where its schema is."""
    top = fields_page("report.json", [report.Report, report.Row, report.Measurement, report.Finding])
    head, _, rest = top.partition("\n")
    about = (
        "Every command that measures writes one (`-o DIRECTORY`, or `--json` on stdout). "
        "[report.schema.json](report.schema.json) is its JSON Schema (draft 2020-12), made from the same classes: "
        "`check-jsonschema --schemafile docs/reference/report.schema.json report.json`. Its `measures` lists the "
        "[quantities](measures.md): a measurement of another name is allowed.\n\n"
        "A number that could not be measured is null, and the note beside it says why. Within schema 1 a later version "
        "may add keys at the top level, which readers ignore; rows, measurements and findings have these keys only."
    )
    return f"{head}\n\n{about}\n{rest}"


def measures_page() -> str:
    """Return a row for each quantity of the vocabulary."""
    about = (
        "The quantities that reports hold, each a row of a file in `vlatool/measures/`; other packages add some "
        "([guide](../guides/add-a-method.md)). A part in braces is that of the policy or the command."
    )
    rows = ["| name | in words | unit | better | shown with | interval |", "|---|---|---|---|---|---|"]
    rows += [f"| `{name}` | {' | '.join(map(str, each.values()))} |" for name, each in measures.descriptions().items()]
    return f"# Measures\n\n{about}\n\n" + "\n".join(rows) + "\n"


def schema_page() -> str:
    """Return the JSON Schema of a report, from the dataclasses, their vocabularies and their docstrings."""
    root = _object(report.Report, ("schema",))
    defs = {kind.__name__: _object(kind) for kind in (report.Row, report.Measurement, report.Finding)}
    head = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$comment": "written by docs/generate.py from the code; do not edit",
        "title": "vlatool report",
    }
    known = {"measures": measures.descriptions()}
    return json.dumps({**head, **root, "additionalProperties": True, "$defs": defs, **known}, indent=1) + "\n"


def output_schema_page() -> str:
    """Return the JSON Schema of every document that a command prints with ``--json``."""
    head = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$comment": "written by docs/generate.py from the code; do not edit",
        "title": "what vlatool prints with --json",
        "commands": COMMANDS,
    }
    defs = definitions(json.loads(schema_page()))
    documents = dict.fromkeys(["failed", *(name for names in COMMANDS.values() for name in names)])
    any_of = [{"$ref": f"#/$defs/{name}"} for name in documents]
    return json.dumps({**head, "anyOf": any_of, "$defs": defs}, indent=1) + "\n"


def json_page() -> str:
    """Return which command prints which document."""
    return inspect.cleandoc(JSON_ABOUT) + "\n\n| command | document |\n|---|---|\n" + "\n".join(
        f"| `vlatool {command}` | {', '.join(f'`{name}`' for name in names)} |" for command, names in COMMANDS.items()
    ) + "\n"  # fmt: skip


JSON_ABOUT = """
    # --json

    Every command takes `--json`; standard output then holds one JSON document: on success, on failure, on a wrong
    option, and on Ctrl-C. Anything else that is printed meanwhile, by a policy, its libraries or the processes that
    they start, goes to standard error.

    The document of a command that exits with a code other than 0 has the key `error`: `type` (a class of
    [errors](errors.md), `OSError`, `MemoryError`, `Interrupted`, `Terminated` or `InternalError`), `message`, `fix`
    (what to do; may be empty) and `exit_code`. It stands alone, or next to a result, such as the report of a gate
    that fails: `vlatool gate CANDIDATE --json | jq -r '.error.fix // "pass"'`.

    A number that could not be measured is null. A report's raw samples are left out (a benchmark has megabytes of
    them); `raw_samples` says how many there are and which `report.json` keeps them, and `--raw` prints them.

    [output.schema.json](output.schema.json) is the JSON Schema (draft 2020-12); the document of a command is its
    `$defs/NAME`, and `$defs/failed` where an error stands alone.
"""


WORDS = {
    "verdict": report.VERDICTS,
    "validity": report.VALIDITIES,
    "role": report.ROLES,
    "origin": report.ORIGINS,
    "effect": report.EFFECTS,
}
NARROWER: dict[str, dict[str, Any]] = {
    "schema": {"const": report.SCHEMA},
    "value": {"type": ["number", "null"]},
    "samples": {"type": "integer", "minimum": 0},
    "confidence": {"type": "number", "minimum": 0, "maximum": 1},
}
"""What the type of a field does not say."""


def _object(kind: Any, also_required: Sequence[str] = ()) -> dict[str, Any]:
    """Return the schema of one dataclass."""
    text, meanings = _described(kind)
    hints = typing.get_type_hints(kind)
    properties, required = {}, list(also_required)
    for field in dataclasses.fields(kind):
        schema = {"enum": list(WORDS[field.name])} if field.name in WORDS else _type(hints[field.name])
        meaning = meanings.get(field.name, "").replace("``", "")
        properties[field.name] = {**NARROWER.get(field.name, schema), **({"description": meaning} if meaning else {})}
        if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            required.append(field.name)
    return {
        "type": "object", "description": text, "properties": properties, "required": required,
        "additionalProperties": False,
    }  # fmt: skip


def _type(hint: Any) -> dict[str, Any]:
    """Return the schema of a type; a float inside a list may be null, since NaN is."""
    simple = {str: "string", int: "integer", float: "number"}
    if hint in simple:
        return {"type": simple[hint]}
    if dataclasses.is_dataclass(hint):
        return {"$ref": f"#/$defs/{getattr(hint, '__name__', '')}"}
    inner = typing.get_args(hint)
    if hint is Any or not inner:
        return {}
    if type(None) in inner:
        return {"type": ["number", "null"]}
    if typing.get_origin(hint) in (list, tuple):
        return {"type": "array", "items": {"type": ["number", "null"]} if inner[0] is float else _type(inner[0])}
    values = _type(inner[1])
    return {"type": "object", **({"additionalProperties": values} if values else {})}


def _described(kind: Any) -> tuple[str, dict[str, str]]:
    """Split a docstring into its text and the meaning of each argument."""
    text, _, arguments = inspect.cleandoc(kind.__doc__ or "").partition("\nArgs:\n")
    meanings: dict[str, str] = {}
    names: list[str] = []
    for line in arguments.splitlines():
        head = re.match(r"    (\w+(?:, \w+)*): (.*)", line)
        if head:
            names = head[1].split(", ")
            meanings.update(dict.fromkeys(names, head[2]))
        elif line.startswith("        "):
            meanings.update({name: f"{meanings[name]} {line.strip()}" for name in names})
    return text.strip(), {name: words.replace("|", "or") for name, words in meanings.items()}


def errors_page() -> str:
    """Return the tree of errors and the exit codes."""
    signals = "130: interrupted by Ctrl-C. 143 and 129: ended by SIGTERM or SIGHUP. Unfinished output is removed."
    return f"# Errors and exit codes\n\n```\n{inspect.cleandoc(errors.__doc__ or '')}\n```\n\n{signals}\n"


def profiles_page() -> str:
    """Return a row for each shipped profile."""
    rows = ["# Hardware profiles\n", "| name | board |", "|---|---|"]
    rows += [f"| `{name}` | {load_profile(name).title} |" for name in profile_names()]
    return "\n".join(rows) + "\n\nEvery figure with its source: `vlatool profiles show NAME`.\n"


def _read(path: Path) -> str:
    return path.read_text(encoding="utf-8") if path.is_file() else ""


if __name__ == "__main__":
    main()
