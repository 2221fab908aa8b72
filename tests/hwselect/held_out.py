"""Part a file of published latencies: what a fit may see, and whole models and whole devices that it does not.

python tests/hwselect/held_out.py POINTS.csv -o out/parts --share 0.3 --seed 0
vlatool hwselect fit out/parts/rest.csv -o out/fit
VLATOOL_LATENCY=out/fit vlatool hwselect score out/parts/models.csv
VLATOOL_LATENCY=out/fit vlatool hwselect score out/parts/devices.csv
"""

from __future__ import annotations

import argparse
import csv
import random
from pathlib import Path


def main() -> None:
    """Write rest.csv, models.csv (held-out models on devices that were seen) and devices.csv."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("points", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--share", type=float, default=0.3, help="of the models, and of the devices (0.3)")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    with given.points.open(newline="", encoding="utf-8") as stream:
        reader = csv.DictReader(stream)
        columns, rows = list(reader.fieldnames or ()), list(reader)
    dealt = random.Random(given.seed)
    models, devices = (
        set(dealt.sample(names, round(given.share * len(names))))
        for names in (sorted({row[column] for row in rows}) for column in ("model", "device"))
    )
    parts = {
        "devices": [row for row in rows if row["device"] in devices],
        "models": [row for row in rows if row["device"] not in devices and row["model"] in models],
        "rest": [row for row in rows if row["device"] not in devices and row["model"] not in models],
    }
    given.output.mkdir(parents=True, exist_ok=True)
    for name, part in parts.items():
        with (given.output / f"{name}.csv").open("w", newline="", encoding="utf-8") as stream:
            writer = csv.DictWriter(stream, columns)
            writer.writeheader()
            writer.writerows(part)
        print(f"{name}: {len(part)} rows")


if __name__ == "__main__":
    main()
