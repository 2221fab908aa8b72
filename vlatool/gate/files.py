"""Files that ``vlatool gate init`` writes: a gate with every line explained, and jobs that run it."""

from __future__ import annotations

import inspect
import json
import shlex

from vlatool.gate.claim import Claim
from vlatool.gate.config import claim_classes
from vlatool.machine.version import VERSION

GATE = """\
# What a change may cost. `vlatool gate CANDIDATE` runs the baseline anew beside the candidate and exits with
# 0 (pass), 1 (fail) or 5 (inconclusive: the samples cannot decide). A claim that is null is not examined.
schema: 1
baseline: {baseline}    # a bundle, kept in the repository or fetched before the gate runs
"""

GITHUB = """\
name: policy gate
on: pull_request
jobs:
  gate:
    runs-on: ubuntu-latest   # or [self-hosted, jetson], where the policy will run
    timeout-minutes: 60
    steps:
      - uses: actions/checkout@v4
        with:
          lfs: true
      - uses: actions/setup-python@v5
        with:
          python-version: "3.11"
      # ort: the engine; build: YAML and export; text, sim, metaworld: a tokenizer, episodes. From an index or a wheel.
      - run: pip install "vlatool[ort,build]>={version}"
      # exit code 5 (inconclusive) makes this job red, too; to let it pass, append: || [ $? -eq 5 ]
      - run: vlatool gate {candidate} --config gate.yaml -o gate-report --junit gate.xml
      - uses: actions/upload-artifact@v4
        if: always()
        with:
          name: gate
          path: |
            gate-report
            gate.xml
"""

GITLAB = """\
# .gitlab-ci.yml must say: include: {{local: .gitlab/policy-gate.yml}}
policy gate:
  image: python:3.11
  timeout: 1h
  rules:
    - if: $CI_PIPELINE_SOURCE == "merge_request_event"
  script:
    # ort: the engine; build: YAML and export; text, sim, metaworld: a tokenizer, episodes. From your index or a wheel.
    - pip install "vlatool[ort,build]>={version}"
    - vlatool gate {candidate} --config gate.yaml -o gate-report --junit gate.xml
  allow_failure:
    exit_codes: 5   # inconclusive: shown as a warning
  artifacts:
    when: always
    paths: [gate-report]
    reports:
      junit: gate.xml
"""


def gate_files(baseline: str, candidate: str) -> dict[str, str]:
    """Return path -> text of the files, for a baseline and a candidate as paths in the repository."""
    values = {"baseline": json.dumps(baseline), "candidate": shlex.quote(candidate), "version": VERSION}
    return {
        "gate.yaml": GATE.format(**values) + "".join(map(_example, claim_classes().values())),
        ".github/workflows/policy-gate.yml": GITHUB.format(**values),
        ".gitlab/policy-gate.yml": GITLAB.format(**values),
    }


def _example(claim: type[Claim]) -> str:
    """Return the lines about a claim; it is off where it says nothing else."""
    first = inspect.cleandoc(claim.__doc__ or "").partition("\n")[0]
    return claim.example or f"\n{claim.name()}: null  # {first}\n"
