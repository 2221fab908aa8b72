"""What a profile's board would need for a bundle, as predictions that say so."""

from __future__ import annotations

from vlatool.bundle import Bundle
from vlatool.hwselect._roofline import predict, predict_memory
from vlatool.hwselect._workload import workload
from vlatool.profile import Profile
from vlatool.report import Measurement


def predictions(profile: Profile, bundle: Bundle) -> list[Measurement]:
    """Return predicted latency and memory of a bundle on a board; NaN with a note where there is no ground for one."""
    load = workload(bundle)
    engine = bundle.manifest.engine if bundle.manifest.engine in profile.engines else None
    return [predict(profile, load, engine), predict_memory(profile, load, engine)]
