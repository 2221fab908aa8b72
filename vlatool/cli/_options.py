"""Options and arguments that several commands have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vlatool.cli import _complete

BundleOrSource = Annotated[
    str, typer.Argument(help="a bundle or a policy source", show_default=False, autocompletion=_complete.sources)
]
AsJson = Annotated[bool, typer.Option("--json", help="print JSON on stdout")]
Force = Annotated[bool, typer.Option("--force", help="replace an output that exists")]
Raw = Annotated[bool, typer.Option("--raw", help="keep every raw sample in the JSON of --json")]
ReportFolder = Annotated[Path | None, typer.Option("-o", "--output", help="directory for the report")]
BundlePath = Annotated[Path, typer.Argument(help="a bundle", show_default=False, autocompletion=_complete.bundles)]
Workers = Annotated[
    str | None,
    typer.Option(
        "--workers", metavar="N|ray", help="processes for closed-loop episodes, all cores if unset; or ray (ray:N): "
        "workers of a Ray cluster (N at most)",
    ),
]  # fmt: skip
ProfileName = Annotated[
    str, typer.Argument(help="name of a profile, or a YAML file", show_default=False, autocompletion=_complete.profiles)
]
MapNames = Annotated[
    list[str] | None,
    typer.Option(
        "--map", metavar="NAME=RECORDED", help="name in the recording of an input or the action, where it differs; "
        "also a part or several parts: state=qpos[0:7]+gripper",
    ),
]  # fmt: skip
BundleEngine = Annotated[
    str, typer.Option("--engine", help="engine; the bundle's when not given", autocompletion=_complete.engines)
]
Threads = Annotated[int | None, typer.Option("--threads", min=1, help="threads; all cores when not given")]
RobotName = Annotated[str, typer.Option("--robot", help="robot whose limits no action leaves; none when not given")]
StepDeadline = Annotated[
    float | None,
    typer.Option("--deadline-ms", help="ms in which a control step is answered; the control period when not given"),
]
Neutral = Annotated[str, typer.Option("--neutral", help="label of the discrete action without motion")]
BusName = Annotated[
    str,
    typer.Option(
        "--bus",
        metavar="BUS[:ADDRESS]",
        help="bus, with an address where it needs one",
        show_default=False,
        autocompletion=_complete.buses,
    ),
]
Controllers = Annotated[str, typer.Option("--controller", help="controller and wrappers, by name, with commas between")]
