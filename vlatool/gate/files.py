"""What ``vlatool gate init`` writes: a gate with every line explained, and jobs that run it."""

from __future__ import annotations

import json
import shlex

from vlatool.machine.version import VERSION

GATE = """\
# What a change may cost. `vlatool gate CANDIDATE` runs the baseline anew beside the candidate and exits with
# 0 (pass), 1 (fail) or 5 (inconclusive: the samples cannot decide). A claim that is null is not examined.
schema: 1
baseline: {baseline}    # a bundle, kept in the repository or fetched before the gate runs

latency:
  margin: 0.05         # median and mean may be 5 % slower, no more
  worst: 0.5           # and no single observation by more than 50 %
  interim_analyses: [10, 20, 40]  # processes after which it is judged; most changes are decided at the first
  pairs: 150           # calls of each bundle in a process
  threads: 1           # those that the robot runs with
  # also_threads: [4]  # the same is claimed of the latency with so many threads

accuracy:
  max_drop: 0.01       # one point, on the same samples (and episodes) as the baseline
  # data: data/evaluation.npz   # recorded observations and actions; the baseline's own when not given
  # episodes: 200               # also closed-loop episodes, on paired seeds
  # policy: policy              # directory of the policy.yaml that names environment and tasks

answers:
  follows: 0.5         # least correlation with the baseline where nothing is recorded; null: trained anew

memory:
  margin: 0.10         # peak memory of a fresh process

size:
  margin: 0.10         # graphs and assets on disk

# These are about the episodes that accuracy names, where it names any:
motion: null           # where both succeed, neither path nor jerk grows by more than the margin
# motion:
#   margin: 0.10
task_time: null        # where both succeed, the task takes no longer
# task_time:
#   margin: 0.05
worst_task: null       # no task loses more than so many points, however well the others do
# worst_task:
#   max_drop: 0.03
disturbed: null        # nor under late, lost or noisy observations, and what else the environment offers
# disturbed:
#   max_drop: 0.05

deadline: null
# deadline:            # a percentile below a deadline, with 99 % confidence, on the machine that runs the gate
#   ms: 50
#   percent: 99
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
        "gate.yaml": GATE.format(**values),
        ".github/workflows/policy-gate.yml": GITHUB.format(**values),
        ".gitlab/policy-gate.yml": GITLAB.format(**values),
    }
