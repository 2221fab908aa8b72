"""One command for each stage of a kind, its flags made from the fields of the stage's class."""

from __future__ import annotations

import difflib
import inspect
import types
import typing
from collections.abc import Callable
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from vlatool import registry
from vlatool.cli import _complete, _run, _torchrun
from vlatool.cli._default import DefaultGroup
from vlatool.cli._flag_conflicts import refuse_conflicting_flags
from vlatool.errors import PluginError, UsageError, fix_for, suggest
from vlatool.module.source import trust_policies
from vlatool.stage.base import Measure, Stage
from vlatool.stage.build import stage_from

DEFAULTS = {
    "export": "onnx",
    "quantize": "static-int8",
    "benchmark": "latency",
    "prune": "structured",
    "distill": "policy",
    "evaluate": "recorded",
}
"""The method of a command that names none."""


class StageGroup(DefaultGroup):
    """A group whose commands are the files of its kind; each is imported only when it is named."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the methods of this kind."""
        return [name.replace("_", "-") for name in registry.names(self.name or "")]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Build the command of one method."""
        if cmd_name.replace("_", "-") not in self.list_commands(ctx):
            return None
        try:
            stage = registry.load(self.name or "", cmd_name)
        except PluginError as error:
            return failing_command(cmd_name, error)
        return build_command(stage_function(stage), cmd_name, stage.__doc__)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Refuse a first word that is nearly a method."""
        known = self.list_commands(ctx)
        other = "" if self.names_command(ctx, args) or ctx.resilient_parsing else args[0]
        if difflib.get_close_matches(other, known, n=1) and not Path(other).exists():
            raise UsageError(
                f"Unknown {registry.noun_of(self.name or '')} '{other}', and no such file; {suggest(other, known)}.",
                f"{fix_for(other, known)}, or name a policy or bundle that exists",
            )
        return super().parse_args(ctx, args)


def build_command(function: Callable[..., Any], name: str, text: str | None = None, **settings: Any) -> Any:
    """Return the click command of a function."""
    single = typer.Typer(add_completion=False, rich_markup_mode=None)
    single.command(name, help=text, context_settings=settings)(function)
    command = typer.main.get_command(single)
    command.name = name
    return refuse_conflicting_flags(command)


def failing_command(name: str, error: PluginError) -> Any:
    """Return a command that says why another package's cannot run, so that ``--help`` lists all others."""

    def fails(words: Annotated[list[str] | None, typer.Argument(hidden=True)] = None) -> None:
        raise error

    return build_command(fails, name, f"Does not work: {error.message}", ignore_unknown_options=True)


def stage_function(stage: type[Stage]) -> Callable[..., None]:
    """Return a function whose signature has SOURCE, the stage's fields and the common flags."""
    own = {name: _parameter(name, field) for name, field in stage.model_fields.items()}
    measures = issubclass(stage, Measure)
    common = _run.MEASURE_FLAGS if measures else _run.TRANSFORM_FLAGS

    def command(**arguments: Any) -> None:
        context: typer.Context = arguments.pop("context")
        options = {name: arguments.pop(name) for name in own}
        chosen = {name: value for name, value in options.items() if _typed(context, name)}
        name = f"vlatool {stage.kind()} {registry_name(stage)}"
        launch = _torchrun.launch_for(name, trains=getattr(stage, "trains", False))
        built = stage_from(stage, _torchrun.with_processes(chosen, launch), name)
        trust_policies(built)
        if measures:
            _run.measure(typing.cast(Measure, built), **arguments)
        elif launch is not None:
            _torchrun.train(typing.cast(Any, built), launch, **arguments)
        else:
            _run.transform(typing.cast(Any, built), **arguments)

    more = (flags for name, flags in _run.FLAGS_OF.items() if getattr(stage, name, False))
    typed = inspect.Parameter("context", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context)
    parameters = [typed, _run.SOURCE_FLAG, *own.values(), *common, *chain(*more)]
    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return command


def registry_name(stage: type[Stage]) -> str:
    """Return the method's name as typed on the command line."""
    return stage.name().partition(".")[2].replace("_", "-")


def _parameter(name: str, field: FieldInfo) -> inspect.Parameter:
    annotation: Any = field.annotation
    default = field.get_default()
    if _are_numbers(annotation):  # as 0.5,1,2
        annotation, default = str, ",".join(f"{number:g}" for number in default)
    elif typing.get_origin(annotation) is tuple:
        annotation = list.__class_getitem__(typing.get_args(annotation)[0])
        default = list(default or ())
    elif typing.get_origin(annotation) in (typing.Union, types.UnionType):
        arm: Any = next(arm for arm in typing.get_args(annotation) if arm is not type(None))
        annotation = typing.Optional[str if arm == tuple[int, ...] else arm]  # noqa: UP045 (numbers: as 0,2,4)
    flag = f"--{name.replace('_', '-')}"
    flags = (f"{flag}/--no-{flag[2:]}",) if annotation is bool else (flag,)
    required = default is PydanticUndefined
    option = typer.Option(
        ... if required else default,
        *flags,
        help=field.description,
        show_default=not isinstance(default, list),
        autocompletion=_complete.OF_FIELDS.get(name),
    )
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=option, annotation=annotation)


def _are_numbers(annotation: Any) -> bool:
    """Say whether a field takes one number or several."""
    return typing.get_origin(annotation) is tuple and typing.get_args(annotation)[0] is float


def _typed(context: typer.Context, name: str) -> bool:
    """Return whether an option was given, here or by a variable, so that a board's preferences do not count."""
    source = context.get_parameter_source(name)
    return source is not None and "DEFAULT" not in source.name
