"""One command for each robot controller: its flags are the fields of its class, and those that all controllers have."""

from __future__ import annotations

import dataclasses
import difflib
import inspect
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from vlatool import registry
from vlatool.cli import _complete
from vlatool.cli._default import DefaultGroup
from vlatool.cli._document import answer
from vlatool.cli._launch_words import parameters, ros_words, unused_remappings
from vlatool.cli._options import BusName
from vlatool.cli._stages import build_command, failing_command
from vlatool.errors import OutputError, PluginError, UsageError, fix_for, suggest
from vlatool.files.printable import one_line, printable

if TYPE_CHECKING:
    from vlatool.buses import RosWords
    from vlatool.nodes.session import RunPlan, RunResult
    from vlatool.nodes.settings import Setting
    from vlatool.nodes.trace import Trace

BUNDLE = "bundle"
"""The command of a bundle, which runs where the first word names no controller."""


class ControllerGroup(DefaultGroup):
    """A group whose commands are the robot controllers, and that of a bundle."""

    default = BUNDLE

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the controllers, after the command of a bundle."""
        return [BUNDLE, *(name.replace("_", "-") for name in registry.names("controllers"))]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Build the command of one controller."""
        if cmd_name == BUNDLE:
            return super().get_command(ctx, cmd_name)
        if cmd_name.replace("_", "-") not in self.list_commands(ctx):
            return None
        try:
            controller = registry.load("controllers", cmd_name)
        except PluginError as error:
            return failing_command(cmd_name, error)
        return build_command(controller_function(cmd_name, controller), cmd_name, summary_of(controller))

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Refuse a first word that is nearly a controller."""
        known = self.list_commands(ctx)
        other = "" if self.names_command(ctx, args) or ctx.resilient_parsing else args[0]
        if difflib.get_close_matches(other, known, n=1) and not Path(other).exists():
            raise UsageError(
                f"Unknown robot controller '{other}', and no such bundle; {suggest(other, known)}.",
                f"{fix_for(other, known)}, or name a bundle that exists",
            )
        return super().parse_args(ctx, args)


COMMON: dict[str, tuple[Any, Any]] = {
    "bus": (BusName, ""),
    "bundle": (Annotated[Optional[Path], typer.Option("--bundle", help="bundle of the policy",  # noqa: UP045
                                                      autocompletion=_complete.bundles)], None),
    "robot": (Annotated[str, typer.Option("--robot", help="robot whose limits no action of the policy leaves")], ""),
    "settings": (Annotated[Optional[Path], typer.Option("--settings", help="JSON file of settings; flags count "  # noqa: UP045
                                                        "before it")], None),
    "map": (Annotated[Optional[list[str]], typer.Option(  # noqa: UP045
        "--map", metavar="NAME=/TOPIC", help="topic of an input, output or service (or of a topic), where it differs; "
        "policy: also a file, map.yaml")], None),
    "instruction": (Annotated[str, typer.Option("--instruction", help="text to publish to the controller's "
                                                "instruction at the start")], ""),
    "seconds": (Annotated[Optional[float], typer.Option("--seconds", min=0, help="end after so many seconds; at "  # noqa: UP045
                                                        "Ctrl-C or SIGTERM when not given")], None),
    "wait": (Annotated[float, typer.Option("--wait", min=0, help="seconds to wait for publishers of the inputs")], 1.0),
    "node": (Annotated[str, typer.Option("--node", help="name on the bus; vlatool_CONTROLLER when not given")], ""),
    "shared": (Annotated[bool, typer.Option("--shared", help="start even if another node publishes an output")], False),
    "record": (Annotated[Optional[Path], typer.Option("--record", help="new file for what is needed to replay "  # noqa: UP045
                                                      "the run")], None),
    "report": (Annotated[Optional[Path], typer.Option("--report", help="new HTML file: path, levels, latencies, "  # noqa: UP045
                                                      "statuses")], None),
    "deadline_ms": (Annotated[Optional[float], typer.Option("--deadline-ms", min=0, help="ms in which the policy "  # noqa: UP045
                                                            "answers; 0.8 of the period when not given")], None),
    "neutral": (Annotated[str, typer.Option("--neutral", help="label of the discrete action without motion")], ""),
    "engine": (Annotated[str, typer.Option("--engine", help="engine; the bundle's when not given",
                                           autocompletion=_complete.engines)], ""),
    "threads": (Annotated[Optional[int], typer.Option("--threads", min=1, help="threads; all cores when not given")],  # noqa: UP045
                None),
    "seed": (Annotated[Optional[int], typer.Option("--seed", min=0, help="seed of the policy's noise")], None),  # noqa: UP045
    "dry_run": (Annotated[bool, typer.Option("--dry-run", help="show settings and topics; open no bus")], False),
    "print_map": (Annotated[bool, typer.Option("--print-map", help="print a proposed map.yaml; policy alone")], False),
    "as_json": (Annotated[bool, typer.Option("--json", help="print JSON on stdout")], False),
}  # fmt: skip
"""Flags of every controller: name -> annotation and default."""
OF_POLICIES = ("bundle", "robot", "instruction", "deadline_ms", "neutral", "engine", "threads", "seed")
"""Those of controllers that take a policy."""


def controller_function(name: str, controller: type) -> Callable[..., None]:
    """Return a function whose signature has the controller's settings and the common flags."""
    from vlatool.nodes.launch import needs_policy

    flags = flags_of(controller, COMMON)
    takes_policy = needs_policy(controller)
    common = {key: flag for key, flag in COMMON.items()
              if (takes_policy or key not in OF_POLICIES) and (name == "policy" or key != "print_map")}  # fmt: skip

    def command(**arguments: Any) -> None:
        context: typer.Context = arguments.pop("context")
        typed = values_of(controller, context, {key: arguments.pop(key) for key in flags})
        _run(name, typed, arguments, ros_words(context))

    typed = inspect.Parameter("context", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context)
    shared = [inspect.Parameter(key, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
              for key, (annotation, default) in common.items()]  # fmt: skip
    parameters = [typed, *flags.values(), *shared]
    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return command


def summary_of(entry: type) -> str:
    """Return what the docstring of a controller or world says before its arguments."""
    return (inspect.getdoc(entry) or "").partition("\nArgs:")[0].strip()


def flags_of(entry: type, common: Mapping[str, Any]) -> dict[str, inspect.Parameter]:
    """Return the flags of a controller or a world, by setting: not those of objects, nor under a name in ``common``."""
    from vlatool.nodes.settings import settings_of

    return {setting.name: _flag(setting) for setting in settings_of(entry)
            if setting.type is not Mapping and setting.name not in common}  # fmt: skip


def values_of(entry: type, context: typer.Context, typed: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings whose flags were given, as JSON has them."""
    from vlatool.nodes.settings import settings_of

    known = {setting.name: setting for setting in settings_of(entry)}
    return {key: _parsed(known[key], value) for key, value in typed.items() if _is_given(context, key)}


def _flag(setting: Setting) -> inspect.Parameter:
    """Return the flag of a setting; several values are written with commas between them."""
    kind = str if setting.many else setting.type
    flag = f"--{setting.name.replace('_', '-')}"
    flags = (f"{flag}/--no-{flag[2:]}",) if kind is bool else (flag,)
    default = None if setting.default is dataclasses.MISSING else setting.default
    if setting.many and default is not None:
        default = ",".join(map(str, default))
    option = typer.Option(default, *flags, help=one_line(setting.help) or None)
    annotation = kind if default is not None else Optional[kind]  # noqa: UP045
    return inspect.Parameter(setting.name, inspect.Parameter.KEYWORD_ONLY, default=option, annotation=annotation)


def _parsed(setting: Setting, value: Any) -> Any:
    """Return the value of a flag as JSON has it: ``0.5,1`` is a list of numbers."""
    if not setting.many:
        return value
    parts = [part.strip() for part in value.split(",") if part.strip()]
    if setting.type is str:
        return parts
    try:
        return [json.loads(part) for part in parts]
    except ValueError:
        raise UsageError(f"--{setting.name.replace('_', '-')} is '{value}'; allowed: values with commas between.",
                         "write it such as 0.5,1,2") from None  # fmt: skip


def _is_given(context: typer.Context, name: str) -> bool:
    source = context.get_parameter_source(name)
    return source is not None and "DEFAULT" not in source.name


def _run(name: str, typed: Mapping[str, Any], flags: Mapping[str, Any], words: RosWords | None) -> None:
    """Run a controller as its command line says."""
    from vlatool.nodes.fault_watch import fault_text
    from vlatool.nodes.launch import PolicyOptions
    from vlatool.nodes.map_file import split_maps
    from vlatool.nodes.session import RunPlan, default_node, dry_run, run_on_bus, unheard_text, waiting
    from vlatool.nodes.settings import read_settings

    names = ("bundle", "robot", "deadline_ms", "neutral", "engine", "threads", "seed")
    options = PolicyOptions(**{name: flags[name] for name in names if name in flags})
    topics, mapping = split_maps(flags["map"] or [], takes_file=name == "policy")
    node = flags["node"] or default_node(name)
    launch_values = parameters(words, "" if flags["dry_run"] else flags["bus"], node)
    settings = {
        **({} if flags["settings"] is None else read_settings(flags["settings"])), **mapping, **launch_values, **typed,
    }  # fmt: skip
    if flags.get("print_map"):
        typer.echo(_proposed_map(options), nl=False)
        return
    plan = RunPlan(name, settings, options, flags["bus"], node, topics, flags["seconds"], flags["wait"],
                   flags["record"], flags["report"], flags["shared"], flags.get("instruction", ""),
                   words=words)  # fmt: skip
    as_json = flags["as_json"]
    if flags["dry_run"]:
        found = dry_run(plan)
        answer(as_json, found, _plan_lines(found))
        return
    result = run_on_bus(
        plan,
        lambda about: _say(about.node, about.topics, unused_remappings(words, about.node, {*about.topics.values()})),
        lambda *ended: _end(plan, as_json, *ended),
        lambda topics: typer.echo(f"... {printable(waiting(topics))}", err=True),
        lambda fault: typer.echo(f"... {printable(fault_text(fault))}", err=True),
        lambda topics: typer.echo(f"... {printable(unheard_text(topics))}", err=True),
    )
    if result.failure:
        raise OutputError(
            f"The records of the run are not whole: {result.failure}.", "free some space, and run it again"
        )


def _say(node: str, topics: Mapping[str, str], notes: Iterator[str]) -> None:
    text = ", ".join(f"{name} {topic}" for name, topic in topics.items())
    for line in (f"{node} runs: {text}", *notes):
        typer.echo(printable(line), err=True)


def _end(plan: RunPlan, as_json: bool, result: RunResult, trace: Trace) -> None:
    """Hand over what a run was and write its HTML report, however it ended."""
    answer(as_json, result.to_dict(), _lines(result))
    if plan.report is None:
        return
    from vlatool.nodes.report_page import write_page

    write_page(plan.report, result, trace)
    typer.echo(f"report: {printable(str(plan.report))}", err=True)


def _proposed_map(options: Any) -> str:
    from vlatool.nodes.map_file import proposed_text

    if options.bundle is None:
        raise UsageError("--print-map proposes a map for a policy, and none is named.", "pass --bundle BUNDLE")
    return proposed_text(options.bundle)


def _plan_lines(found: Mapping[str, Any]) -> Iterator[str]:
    yield printable(f"{found['controller']} at {found['rate_hz']:g} Hz, node {found['node']}")
    for kind in ("inputs", "outputs", "services"):
        for each in found[kind]:
            yield printable(f"  {kind[:-1]:7}  {each['name']:14}  {each['topic']:28}  {each['type']}")
    for key, value in found["settings"].items():
        yield printable(f"  setting  {key} = {value}")


def _lines(result: RunResult) -> Iterator[str]:
    from vlatool.nodes.fault_watch import fault_text

    found = result.to_dict()
    late, compute, over = (found[name] for name in ("late_ms", "compute_ms", "overhead_ms"))
    yield printable(
        f"{found['steps']} steps in {found['seconds']:.1f} s, {found['skipped']} left out; {found['status']}"
    )
    if found["steps"]:
        yield (f"  late p99 {late['p99']:.2f} ms, controller p50 {compute['p50']:.2f} ms, p99 {compute['p99']:.2f} ms, "
               f"overhead p99 {over['p99']:.2f} ms")  # fmt: skip
    if any(found["overwritten"].values()):
        many = ", ".join(f"{name} {count}" for name, count in found["overwritten"].items() if count)
        yield f"  came faster than the steps: {many}"
    if found["lost_records"] or found["failure"] or found["log_full"]:
        reason = found["failure"] or ("the log was full" if found["log_full"] else f"{found['lost_records']} were lost")
        yield printable(f"  the records of the steps are not whole: {reason}")
    for fault in result.faults:
        yield printable(f"  on the bus: {fault_text(fault)}")
