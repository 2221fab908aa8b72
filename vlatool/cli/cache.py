"""``vlatool cache``."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Iterator
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vlatool.cli._document import answer, document
from vlatool.cli._options import AsJson
from vlatool.errors import DataError, UsageError, suggest
from vlatool.files.printable import amount, printable

if TYPE_CHECKING:
    from vlatool.stage.cache import Contents, Entry

app = typer.Typer(help="List and remove finished stages in the cache.", no_args_is_help=True,
                  rich_markup_mode=None)  # fmt: skip
SECONDS = {"s": 1, "m": 60, "h": 3600, "d": 86_400, "w": 604_800}
BYTES = {"B": 1, "kB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12, "KiB": 2**10, "MiB": 2**20, "GiB": 2**30}
Place = Annotated[Path | None, typer.Option("--cache", help="the cache; $VLATOOL_CACHE or the user's if unset")]


@app.command("size")
def size(cache: Place = None, as_json: AsJson = False) -> None:
    """Print how large the cache is, stage by stage; a recording that stages share is counted once."""
    held = _contents(cache)
    head, stages = _head(held), [_sum(held, what) for what in sorted({entry.what for entry in held.entries})]
    lines = [
        f"{each['stage']:28} {each['entries']:5d} kept  {_human(each['bytes']):>9} of their own" for each in stages
    ]
    shared = f"{'shared':28} {'':10}  {_human(head['shared_bytes']):>9}"
    answer(as_json, head | {"stages": stages}, [*lines, shared, *_total(held)])


@app.command("list")
def list_entries(cache: Place = None, as_json: AsJson = False) -> None:
    """List the cache, least recently used first: age, own size, shared size, name."""
    held = _contents(cache)
    rows = [_entry_row(held, entry) for entry in held.entries]
    lines = [f"{'age':>6}  {'own':>9}  {'shared':>9}  name"]
    for entry, row in zip(held.entries, rows, strict=True):
        sizes = f"{_human(row['bytes']):>9}  {_human(row['shared_bytes']):>9}"
        lines.append(f"{_age(time.time_ns() / 1e9 - entry.used):>6}  {sizes}  {entry.name}")
    answer(as_json, _head(held) | {"entries": rows}, [*lines, *_total(held)])


@app.command("prune")
def prune(
    older_than: Annotated[str, typer.Option(help="remove what has not been used for this long: 30d, 12h, 2w")] = "",
    max_size: Annotated[str, typer.Option(help="remove the least recently used until this much is left: 5GB")] = "",
    everything: Annotated[bool, typer.Option("--all", help="remove everything that no running process uses")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="show what would be removed, and remove nothing")] = False,
    cache: Place = None,
    as_json: AsJson = False,
) -> None:
    """Remove finished stages, which the next run makes again when it needs them.

    What a running process uses stays, and so does everything that vlatool did not write.
    """
    from vlatool.stage import cache as kept

    if everything == bool(older_than or max_size):
        raise UsageError(
            "Nothing is chosen for removal.", "pass --older-than 30d, --max-size 5GB, or both; or only --all"
        )
    age = 0.0 if everything else _amount("--older-than", older_than, SECONDS, "30d") if older_than else None
    most = int(_amount("--max-size", max_size, BYTES, "5GB")) if max_size else None
    root = _cache_root(cache)
    removed = kept.prune(root, older_than_s=age, most_bytes=most, dry_run=dry_run)
    left = kept.contents(root).bytes - (removed.freed if dry_run else 0)
    if as_json:
        document({"cache": str(root), "dry_run": dry_run, "removed": [entry.name for entry in removed.entries],
                  "freed_bytes": removed.freed, "bytes": left, "stays": removed.stays})  # fmt: skip
        return
    for entry in removed.entries:
        typer.echo(f"{'would remove' if dry_run else 'removed'} {entry.name}")
    for name, reason in removed.stays.items():
        typer.echo(f"warning: {name} stays: it {reason}", err=True)
    word = "would free" if dry_run else "freed"
    typer.echo(f"{root}: {word} {_human(removed.freed)}, {_human(left)} kept")


def _cache_root(cache: Path | None) -> Path:
    from vlatool.machine.host import cache_directory
    from vlatool.stage.cache import looks_like_cache

    root = cache or cache_directory()
    if (cache is not None or root.exists()) and not root.is_dir():
        raise DataError(f"No such directory: {root}.", "name the directory of a cache")
    if cache is not None and not looks_like_cache(root):
        raise DataError(f"{root} is not a cache: vlatool keeps nothing in it.", "name the directory of a cache")
    return root


def _contents(cache: Path | None) -> Contents:
    from vlatool.stage.cache import contents

    return contents(_cache_root(cache))


def _amount(option: str, text: str, units: dict[str, int], example: str) -> float:
    """Return what a person wrote as a number and a unit, in the smallest unit."""
    match = re.fullmatch(r"\s*(\d{1,15}(?:\.\d{1,9})?)\s*([A-Za-z]+)\s*", text)
    given, fix = f"{option} is '{text[:40]}'", f"write it as {option} {example}"
    if match is None:
        raise UsageError(f"{given}; it must be a number and a unit, such as {example}.", fix)
    unit = next((name for name in units if name.lower() == match[2].lower()), None)
    if unit is None:
        raise UsageError(f"{given}; {suggest(match[2], units)}.", fix)
    value = float(match[1]) * units[unit]
    if not math.isfinite(value):
        raise UsageError(f"{given}, which is too large.", f"give less, such as {option} {example}")
    return value


def _sum(held: Contents, what: str) -> dict[str, Any]:
    mine = [entry for entry in held.entries if entry.what == what]
    return {"stage": what, "entries": len(mine), "bytes": sum(held.sizes(entry)[0] for entry in mine)}


def _head(held: Contents) -> dict[str, Any]:
    own = sum(held.sizes(entry)[0] for entry in held.entries)
    return {"cache": str(held.cache), "bytes": held.bytes, "shared_bytes": held.bytes - own,
            "unknown": list(held.unknown)}  # fmt: skip


def _entry_row(held: Contents, entry: Entry) -> dict[str, Any]:
    own, shared = held.sizes(entry)
    used = datetime.fromtimestamp(entry.used, timezone.utc).isoformat(timespec="seconds")
    return {"name": entry.name, "stage": entry.what, "used": used, "bytes": own, "shared_bytes": shared}


def _total(held: Contents) -> Iterator[str]:
    yield f"{held.cache}: {_human(held.bytes)} in {amount(len(held.entries), 'entry')}"
    if held.unknown:
        more = f" and {len(held.unknown) - 6} more" if len(held.unknown) > 6 else ""
        yield f"not vlatool's, never removed: {', '.join(map(_on_one_line, held.unknown[:6]))}{more}"


def _on_one_line(name: str) -> str:
    return printable(name).replace("\n", "\\n").replace("\t", "\\t")


def _human(size: float) -> str:
    unit = next((name for name in ("TB", "GB", "MB", "kB") if size >= BYTES[name]), "B")
    return f"{size / BYTES[unit]:.{1 if unit != 'B' else 0}f} {unit}"


def _age(seconds: float) -> str:
    unit = next((name for name in ("d", "h", "m") if seconds >= SECONDS[name]), "s")
    return f"{max(0.0, seconds) / SECONDS[unit]:.0f} {unit}"
