"""From a LeRobot checkpoint and a LeRobot v3 dataset to the report of ``optimize``: one command.

    python tests/validation/foreign/lerobot_optimize.py --python ~/lerobot/bin/python [-o out/lerobot-optimize]

``--python`` has LeRobot 0.6 (``pip install 'lerobot[dataset]==0.6.1'``, Python 3.12); it needs no vlatool. LeRobot
records 24 episodes and trains an ACT policy on them; then ``vlatool optimize CHECKPOINT --calibration DATASET`` runs
here, and the bundle infers without torch. Prints the report, and exits with the code of ``optimize``.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

TRAIN = Path(__file__).with_name("_lerobot_trained.py")
LOADED = """
import sys
import numpy as np
import vlatool

policy = vlatool.load(sys.argv[1])
state, image = (np.zeros(each.shape[1:], each.dtype) for each in policy.spec.inputs)
names = [each.name for each in policy.spec.inputs]
chunk = policy.infer(dict(zip(names, (state, image)))).chunk
finite = np.isfinite(chunk).all()
print(f"loaded; torch imported: {'torch' in sys.modules}; a chunk of {chunk.shape}, finite: {finite}")
"""


def main() -> int:
    """Train with LeRobot where nothing was trained yet, optimize, and load."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python", required=True)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/lerobot-optimize"))
    parser.add_argument("--max-drop", default="relative_error=0.1")
    asked = parser.parse_args()
    folder: Path = asked.output
    if not (folder / "checkpoint/config.json").exists():
        folder.mkdir(parents=True, exist_ok=True)
        subprocess.run([asked.python, TRAIN, folder], check=True, stderr=subprocess.DEVNULL)
    command = ["optimize", folder / "checkpoint", "--calibration", folder / "dataset", "--python", asked.python]
    more = ["--max-drop", asked.max_drop, "-o", folder / "bundle", "--force"]
    code = subprocess.run([sys.executable, "-m", "vlatool", *command, *more], check=False).returncode
    subprocess.run([sys.executable, "-c", LOADED, folder / "bundle"], check=True)
    return code


if __name__ == "__main__":
    sys.exit(main())
