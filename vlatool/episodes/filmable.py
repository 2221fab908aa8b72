"""Whether there is anything to film in the episodes of an environment, asked before they are played."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.episodes.environment import World
from vlatool.episodes.faults import error_context
from vlatool.episodes.film import Camera, images_of
from vlatool.episodes.play import STEP_LIMIT, EpisodesJob, Request
from vlatool.files.messages import from_json, to_json
from vlatool.module.factory import call_factory
from vlatool.stage.base import Context
from vlatool.user_code.children import OnProgress, call


def check_filmable(bundles: Sequence[Bundle], job: EpisodesJob, context: Context) -> None:
    """Refuse to film episodes of which there is no picture.

    A policy that takes images can be filmed without asking; otherwise the environment is made and reset once.

    Raises:
        DataError: when the environment renders nothing and a policy takes no image, or the environment fails.
        SourceError: when it ends the process that it runs in.
    """
    blind = next((bundle for bundle in bundles if not images_of(bundle.manifest.spec)), None)
    if blind is not None:
        request = to_json(Request(str(blind.path.absolute()), "", STEP_LIMIT, job))
        call(f"{__name__}:probe", request, context.progress, job.environment.rpartition(":")[0])


def probe(request: Mapping[str, Any], _tell: OnProgress) -> None:
    """Take the first picture of a ``Request``'s first episode in this process; raises DataError when there is none."""
    asked = from_json(Request, request)
    job, spec = asked.job, Bundle.open(Path(asked.bundle)).manifest.spec
    environment = call_factory(job.environment, Path(job.folder), {"task": job.task})
    try:
        with error_context(job.task, job.seeds[0]):
            observation, _ = World(environment, job.task, spec).reset(job.seeds[0])
            Camera(environment, job.task, spec)(observation)
    finally:
        with contextlib.suppress(Exception):
            environment.close()
