"""What a measurement found, as tests make it up."""

from dataclasses import replace

from vlatool.measurement.results import Benchmark, PolicyRun
from vlatool.telemetry import Summary

QUIET = Summary(10.0, (), None, (), {}, {}, ())


def run_of(policy: PolicyRun, **more) -> Benchmark:
    """A run of one policy on a machine with four processors."""
    plain = Benchmark(begun_s=1000.0, ended_s=1010.0, cpu_s=10.0, wall_s=10.0, switches=30, canary_ms=(1.0,) * 21,
                     policies=(policy,), host={"cores": 4}, telemetry=QUIET)  # fmt: skip
    return replace(plain, **more)
