"""Part a file of published latencies: what a fit may see, and whole models and whole devices that it does not.

    python tests/hwselect/held_out.py POINTS.csv -o out/parts --share 0.3 --seed 0
    python tests/hwselect/held_out.py POINTS.csv -o out/folds --folds 5
    vlatool hwselect fit out/folds/0/rest.csv -o out/fit --anew
    VLATOOL_LATENCY=out/fit vlatool hwselect score out/folds/0/held.csv

The first writes rest.csv, models.csv and devices.csv; the second 0/rest.csv, 0/held.csv, 1/rest.csv and so on.
"""

from __future__ import annotations

import argparse
import csv
import random
from pathlib import Path

Rows = list[dict[str, str]]


def main() -> None:
    """Write the parts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("points", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--share", type=float, default=0.3, help="of the models, and of the devices (0.3)")
    parser.add_argument("--folds", type=int, help="deal the devices (but NPUs) into so many folds, and no models")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    with given.points.open(newline="", encoding="utf-8") as stream:
        reader = csv.DictReader(stream)
        columns, rows = list(reader.fieldnames or ()), list(reader)
    dealt = random.Random(given.seed)
    if given.folds:
        for number, parts in enumerate(device_folds(rows, given.folds, dealt)):
            write(given.output / str(number), columns, parts)
    else:
        write(given.output, columns, models_and_devices(rows, given.share, dealt))


def models_and_devices(rows: Rows, share: float, dealt: random.Random) -> dict[str, Rows]:
    """Hold out a share of the models (on devices that are seen), and a share of the devices."""
    models, devices = (
        set(dealt.sample(names, round(share * len(names))))
        for names in (sorted({row[column] for row in rows}) for column in ("model", "device"))
    )
    return {
        "devices": [row for row in rows if row["device"] in devices],
        "models": [row for row in rows if row["device"] not in devices and row["model"] in models],
        "rest": [row for row in rows if row["device"] not in devices and row["model"] not in models],
    }


def device_folds(rows: Rows, count: int, dealt: random.Random) -> list[dict[str, Rows]]:
    """Hold out each device once."""
    rows = [row for row in rows if "hailo" not in (row["device"] + row["runtime"]).lower()]
    names = sorted({row["device"] for row in rows})
    dealt.shuffle(names)
    folds = [set(names[number::count]) for number in range(count)]
    return [
        {
            "rest": [row for row in rows if row["device"] not in held],
            "held": [row for row in rows if row["device"] in held],
        }
        for held in folds
    ]


def write(folder: Path, columns: list[str], parts: dict[str, Rows]) -> None:
    """Write each part as a file."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, part in parts.items():
        with (folder / f"{name}.csv").open("w", newline="", encoding="utf-8") as stream:
            writer = csv.DictWriter(stream, columns)
            writer.writeheader()
            writer.writerows(part)
        print(f"{folder / name}.csv: {len(part)} rows")


if __name__ == "__main__":
    main()
