"""JSON Schemas of what the commands print with ``--json``; ``docs/generate.py`` writes them to ``docs/reference``."""

from __future__ import annotations

import inspect
from typing import Any

from vlatool import errors
from vlatool.cli._failure import TYPES
from vlatool.hardware.profile import Profile

Schema = dict[str, Any]
TEXT: Schema = {"type": "string"}
NUMBER: Schema = {"type": ["number", "null"]}
INTEGER: Schema = {"type": "integer"}
FLAG: Schema = {"type": "boolean"}
ANY_OBJECT: Schema = {"type": "object"}
SPREAD: Schema = {
    "type": "object", "properties": {"p50": NUMBER, "p99": NUMBER, "samples": INTEGER},
    "required": ["p50", "p99", "samples"], "additionalProperties": False,
}  # fmt: skip
ERROR: Schema = {"$ref": "#/$defs/error"}

COMMANDS: dict[str, tuple[str, ...]] = {
    "optimize": ("report", "plan"),
    "export": ("made",),
    "prune": ("made",),
    "distill": ("made",),
    "quantize": ("made",),
    "benchmark": ("report",),
    "evaluate": ("report",),
    "compare": ("report",),
    "explain": ("report",),
    "gate run": ("report",),
    "gate init": ("written",),
    "hwselect select": ("report",),
    "hwselect score": ("score", "scores"),
    "hwselect fit": ("written",),
    "cache size": ("cache_size",),
    "cache list": ("cache_list",),
    "cache prune": ("cache_pruned",),
    "data inspect": ("inspection",),
    "data sample": ("written",),
    "verify": ("report",),
    "inspect": ("manifest", "sensitivity"),
    "deploy": ("deployment",),
    "rollback": ("store",),
    "status": ("store",),
    "sign": ("signature", "openssf", "key"),
    "verify-signature": ("signature",),
    "rebuild": ("rebuilt",),
    "doctor": ("checks",),
    "run": ("controller_run", "planned_run"),
    "run bundle": ("dry_run",),
    "sim": ("simulated_robot",),
    "topics": ("bus_topics",),
    "serve": ("served",),
    "record": ("recorded_run", "recorded_bus"),
    "replay": ("replayed_run", "replayed_controller"),
    "simulate": ("simulation",),
    "telemetry": ("telemetry",),
    "profiles list": ("profiles",),
    "profiles show": ("profile",),
    "profiles diff": ("differences",),
    "profiles validate": ("validated",),
    "profiles new": ("written",),
    "profiles calibrate": ("calibrated",),
    "new": ("policy",),
    "samples list": ("samples",),
    "samples make": ("sample",),
}
"""Command, or group of commands -> what it prints on success; the first is the usual one."""


def document(description: str, /, **properties: Schema) -> Schema:
    """Return the schema of an object with exactly these keys; an error may be among them."""
    return {
        "type": "object", "description": description, "properties": {**properties, "error": ERROR},
        "required": list(properties), "additionalProperties": False,
    }  # fmt: skip


def many(items: Schema) -> Schema:
    """Return the schema of a list."""
    return {"type": "array", "items": items}


def by_name(values: Schema) -> Schema:
    """Return the schema of an object with names of any kind."""
    return {"type": "object", "additionalProperties": values}


def record(**properties: Schema) -> Schema:
    """Return the schema of an object inside of another one, with exactly these keys."""
    return {"type": "object", "properties": properties, "required": list(properties), "additionalProperties": False}


STAGE = record(stage=TEXT, options=ANY_OBJECT)
SOURCE = record(policy={"type": ["string", "null"]}, stage=TEXT, options=ANY_OBJECT)
PLAN = record(
    source=SOURCE, export=many(STAGE), candidates=by_name(many(STAGE)), search=FLAG, pruning=ANY_OBJECT,
    benchmark=record(iterations=INTEGER, threads=INTEGER), evaluate=record(recorded=FLAG, episodes=INTEGER),
    limits=ANY_OBJECT, profile={"type": ["string", "null"]}, computes={"type": ["string", "null"]}, cache=TEXT,
)  # fmt: skip
PHASE = record(name=TEXT, runs=INTEGER, ms=NUMBER, shares=by_name(NUMBER), parts=by_name(NUMBER))
SHIFT = record(recorded=TEXT, installed=TEXT)
PART_TIME = record(part=TEXT, steps=INTEGER, mean_ms=NUMBER, p50_ms=NUMBER, p99_ms=NUMBER, max_ms=NUMBER, share=NUMBER)
GAUGE = record(unit=TEXT, min=NUMBER, mean=NUMBER, max=NUMBER, times=many(NUMBER), values=many(NUMBER), note=TEXT)
COUNTER = record(unit=TEXT, difference=NUMBER, seconds=NUMBER, note=TEXT)
SLOT = record(
    bundle=TEXT, identity=TEXT, name=TEXT, version=TEXT, release=INTEGER, key=TEXT, problem=TEXT,
)  # fmt: skip
TRIAL = record(ticks=INTEGER, seconds=NUMBER, latency_ms=NUMBER, memory_mb=NUMBER, starts=INTEGER)
STORE: dict[str, Schema] = {
    "store": TEXT, "active": TEXT, "slots": by_name(SLOT), "change": INTEGER,
    "trial": {"anyOf": [TRIAL, {"type": "null"}]}, "highest_release": INTEGER, "highest_version": TEXT,
    "required_keys": many(TEXT), "last_rollback": TEXT,
}  # fmt: skip
SHADOW = record(runs=INTEGER, p50_ms=NUMBER, p95_ms=NUMBER, worst_ms=NUMBER, growth_mb=NUMBER, violation=TEXT)
CACHE: dict[str, Schema] = {"cache": TEXT, "bytes": INTEGER, "shared_bytes": INTEGER, "unknown": many(TEXT)}
RAW = record(omitted={"type": "integer", "minimum": 1}, file={"type": ["string", "null"]}, fix=TEXT)


def definitions(report: Schema) -> dict[str, Schema]:
    """Return the schema of every document by name; ``report`` is that of a report with definitions in ``$defs``."""
    shown = {**report["properties"], "raw_samples": {**RAW, "description": "raw samples that were left out"}}
    return {
        **report["$defs"],
        "error": _error(),
        "failed": document("What a command prints that found nothing out.") | {"required": ["error"]},
        "report": {
            **{key: report[key] for key in ("type", "description", "required")},
            "properties": {**shown, "error": ERROR},
            "additionalProperties": False,
        },
        "profile": {**_inlined(Profile.model_json_schema(mode="serialization")), "description": "A hardware profile."},
        **_documents_of_bundles(),
        **_documents_of_robots(),
        **_documents_of_stores(),
        **_documents_of_deployment(),
        **_documents_of_machines(),
    }


def _documents_of_robots() -> dict[str, Schema]:
    """Return the documents about robot controllers, buses and simulated robots."""
    end = record(name=TEXT, topic=TEXT, type=TEXT)
    texts, faults = many(TEXT), many(record(topic=TEXT, count=INTEGER, error=TEXT))
    return {
        "controller_run": document(
            "A run of a robot controller; times of its steps in ms.",
            controller=TEXT, node=TEXT, topics=by_name(TEXT), steps=INTEGER, skipped=INTEGER, seconds=NUMBER,
            status=TEXT, late_ms=SPREAD, compute_ms=SPREAD, overhead_ms=SPREAD, overwritten=by_name(INTEGER),
            lost_records=INTEGER, log_full=FLAG, failure=TEXT, faults=faults,
        ),
        "planned_run": document(
            "What a run of a robot controller would be.", controller=TEXT, node=TEXT, rate_hz=NUMBER, inputs=many(end),
            outputs=many(end), services=many(end), settings=ANY_OBJECT,
        ),
        "simulated_robot": document(
            "What a simulated robot did.", robot=TEXT, seconds=NUMBER, reports=INTEGER, commands=INTEGER,
            behind_s=NUMBER, truth=ANY_OBJECT, faults=faults,
        ),
        "bus_topics": document("Topics on a bus.", bus=TEXT, topics=many(record(
            topic=TEXT, types=texts, publishers=texts, subscribers=texts, messages=INTEGER, hz=NUMBER, age_ms=NUMBER,
            problems=texts))),
        "recorded_bus": document(
            "A bag of a bus: topic -> messages, and why topics are not in it.", file=TEXT, messages=by_name(INTEGER),
            unknown=by_name(TEXT), seconds=NUMBER,
        ),
        "replayed_controller": document(
            "Steps of a controller that were computed again; note: why the replay ends before the recording.",
            steps=INTEGER, messages=INTEGER, differing=INTEGER, unused=INTEGER, unheard=INTEGER, note=TEXT, equal=FLAG,
            difference={"anyOf": [{"type": "null"}, record(
                step=INTEGER, output=TEXT, index=INTEGER, recorded=TEXT, computed=TEXT)]},
        ),
    }  # fmt: skip


def _documents_of_bundles() -> dict[str, Schema]:
    """Return the documents on policies and bundles that only the command line has."""
    files = many(record(file=TEXT, bytes=INTEGER, identical=FLAG, why=TEXT))
    return {
        "plan": document("What optimize would do.", plan=PLAN),
        "made": document(
            "A bundle that was written; precision: graph -> dtype -> share of its multiply-accumulates; pruned: shares "
            "of the work asked for and reached, and who keeps the rest.",
            bundle=TEXT, hash=TEXT, bytes=INTEGER, precision=by_name(by_name(NUMBER)), findings=many(ANY_OBJECT),
            pruned={"anyOf": [record(
                asked=NUMBER, reached=NUMBER, macs=many(INTEGER), keeps=by_name(NUMBER), without_rule=many(TEXT),
            ), {"type": "null"}]},
            board={"anyOf": [record(
                board=TEXT, graphs_before={"type": ["integer", "null"]}, graphs_after=INTEGER,
                predictions=by_name(record(value=NUMBER, low=NUMBER, high=NUMBER, unit=TEXT, note=TEXT)),
                actions={"anyOf": [record(name=TEXT, value=NUMBER), {"type": "null"}]},
            ), {"type": "null"}]},
            difference={"anyOf": [
                record(mean=NUMBER, worst=NUMBER, samples=INTEGER, recorded=FLAG), {"type": "null"},
            ]},
        ),
        "manifest": {
            "type": "object", "description": "manifest.json of the bundle, byte by byte, when there is no error.",
            "required": ["name", "version", "spec", "graphs", "files"], "properties": {"error": ERROR},
        },
        "sensitivity": document(
            "Which element of an input moves which element of the action, the largest effect first.",
            identity=TEXT, samples=INTEGER, recorded=FLAG, left_out=many(TEXT), influences=many(record(
                input=TEXT, output=TEXT, slope=NUMBER, unit=TEXT, effect=NUMBER, agreement=NUMBER)),
        ),
        "rebuilt": document(
            "A bundle that was made again.",
            bundle=TEXT, source=TEXT, identical=FLAG, hash=record(recorded=TEXT, rebuilt=TEXT), left_out=many(TEXT),
            versions=by_name(SHIFT), stages=many(record(stage=TEXT, graphs_identical=FLAG)), files=files,
            output={"type": ["string", "null"]},
        ),
        "policy": document(
            "A policy directory that was written; unknown: what nobody said.", policy=TEXT, source=TEXT,
            unknown=many(TEXT),
        ),
        "samples": many(record(name=TEXT, description=TEXT)),
        "sample": document("A policy that was written.", policy=TEXT, sample=TEXT, seed=INTEGER),
    }  # fmt: skip


def _documents_of_stores() -> dict[str, Schema]:
    """Return the documents on the cache and on recordings."""
    return {
        "cache_size": document("What the cache holds, stage by stage.", **CACHE, stages=many(
            record(stage=TEXT, entries=INTEGER, bytes=INTEGER))),
        "cache_list": document("What the cache holds, the least recently used first.", **CACHE, entries=many(
            record(name=TEXT, stage=TEXT, used=TEXT, bytes=INTEGER, shared_bytes=INTEGER))),
        "cache_pruned": document(
            "What was removed from the cache, or would be; stays: name -> why.",
            cache=TEXT, dry_run=FLAG, removed=many(TEXT), freed_bytes=INTEGER, bytes=INTEGER, stays=by_name(TEXT),
        ),
        "inspection": document(
            "What a recording holds; low and high are of finite numbers; gaps are the largest of gap_count.",
            path=TEXT, format=TEXT, episodes=INTEGER, steps=INTEGER, hz=NUMBER, measured_hz=NUMBER,
            lengths=many(INTEGER), tasks=INTEGER, action=TEXT, columns=many(record(
                name=TEXT, dtype=TEXT, shape=many(INTEGER), low=NUMBER, high=NUMBER, not_finite=INTEGER,
                constant=many(INTEGER), drift_ms=NUMBER)),
            gaps=many(record(episode=INTEGER, step=INTEGER, seconds=NUMBER)), gap_count=INTEGER, findings=many(TEXT),
        ),
    }  # fmt: skip


def _documents_of_deployment() -> dict[str, Schema]:
    """Return the documents on what is deployed, and on signatures."""
    return {
        "store": document("What is deployed; problem: what is wrong with the files of a slot.", **STORE),
        "deployment": document("What is deployed, and how the new bundle answered in its shadow run.", **STORE,
                               shadow=SHADOW),
        "signature": document("A signature of a bundle.", path=TEXT, schema=INTEGER, bundle=TEXT, release=INTEGER,
                              key=TEXT, signature=TEXT),
        "openssf": document("A signature of a bundle for the tools of OpenSSF Model Signing.", path=TEXT, bundle=TEXT,
                            key=TEXT),
        "key": document("A key that was made.", private=TEXT, public=TEXT, key=TEXT),
    }  # fmt: skip


def _documents_of_machines() -> dict[str, Schema]:
    """Return the documents on this machine and on boards."""
    status = {"enum": ["ok", "warn", "missing"]}
    both = {"type": "array", "items": NUMBER}
    return {
        "checks": many(record(name=TEXT, status=status, finding=TEXT, fix=TEXT)),
        "dry_run": document(
            "Layers from the robot to the graphs; times in ms, of a rung only where it infers.",
            bundle=TEXT, robot=TEXT, period_ms=NUMBER, deadline_ms=NUMBER, layers=many(record(layer=TEXT, does=TEXT)),
            inference=SPREAD, answer=SPREAD, missed=NUMBER,
            rungs=many(record(source=TEXT, time={"anyOf": [SPREAD, {"type": "null"}]})),
            cadence=record(parts=many(PART_TIME), misses=INTEGER, latent={"anyOf": [PART_TIME, {"type": "null"}]}),
            engine=ANY_OBJECT, slow={"anyOf": [SPREAD, {"type": "null"}]},
        ),
        "served": document(
            "What was served; times until an answer in ms where there were answers.",
            bundle=TEXT, addresses=by_name(TEXT), seconds=NUMBER, requests=INTEGER, missed=INTEGER, failed=INTEGER,
            times=by_name(NUMBER), lost_records=INTEGER,
        ),
        "recorded_run": document(
            "A file of recorded control steps.", file=TEXT, bytes=INTEGER, steps=INTEGER, seed=INTEGER, failed=INTEGER
        ),
        "replayed_run": document(
            "Control steps that were computed again; note: why the recording ends before its run.",
            steps=INTEGER, equal=FLAG, note=TEXT, difference={"anyOf": [{"type": "null"}, record(
                step=INTEGER, output=TEXT, element=many(INTEGER), recorded=TEXT, replayed=TEXT)]},
        ),
        "simulation": document(
            "Predicted, not measured; latency_ms: value, low, high.",
            source=TEXT, profile=TEXT, mode=TEXT, engine=TEXT, precision=TEXT, origin={"const": "predicted"},
            latency_ms=both, regime=TEXT, memory_mb=both, watts=both, joules=NUMBER, execute=INTEGER,
            control_hz=NUMBER, phases=many(PHASE), timeline={"type": "array"}, changes={"type": "array"},
        ),
        "telemetry": document(
            "What the machine reported; a reading's times are seconds.",
            seconds=NUMBER, energy=many(ANY_OBJECT), throttled={"type": ["boolean", "null"]}, throttling=many(TEXT),
            gauges=by_name(GAUGE), counters=by_name(COUNTER),
            unmeasured=many(record(reader=TEXT, reason=TEXT, other_board=FLAG)),
        ),
        "score": {"type": "object", "description": "Error and coverage.", "properties": {"error": ERROR}},
        "scores": by_name({"$ref": "#/$defs/score"}),
        "profiles": many({"$ref": "#/$defs/profile"}),
        "differences": many({"type": "object", "required": ["field"]}),
        "validated": document("Profiles by name, and what is wrong with others.", valid=many(TEXT), wrong=many(TEXT)),
        "calibrated": document("Measurements given to the latency model.", kept_in=TEXT, measured=many(ANY_OBJECT)),
        "written": document("Files that were written.", written=many(TEXT)),
    }  # fmt: skip


def _error() -> Schema:
    classes = [name for name, kind in vars(errors).items() if inspect.isclass(kind)
               and issubclass(kind, errors.VlatoolError)]  # fmt: skip
    return {
        "description": "Why a command did not end with 0; the same is printed on standard error.",
        **record(
            type={"enum": [*classes, *TYPES]}, message=TEXT, fix={**TEXT, "description": "what to do; may be empty"},
            exit_code={"type": "integer", "minimum": 1},
        ),
    }  # fmt: skip


def _inlined(schema: Schema) -> Schema:
    """Return a schema with its own definitions inlined: a reference starts at the document's root."""
    defs = schema.get("$defs", {})

    def walk(value: Any) -> Any:
        if isinstance(value, dict):
            named = str(value.get("$ref", "")).removeprefix("#/$defs/")
            return walk(defs[named]) if named else {key: walk(item) for key, item in value.items() if key != "$defs"}
        return [walk(item) for item in value] if isinstance(value, list) else value

    return dict(walk(schema))
