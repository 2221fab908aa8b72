"""Puts vla-metaworld behind this folder on the import path: what it collects, trains and plays with is used here.

`policy`, `acting` and `environment` are found in this folder first, so what collects and evaluates there runs the
policy of this folder.
"""

import sys
from pathlib import Path

NEIGHBOR = Path(__file__).resolve().parent.parent / "vla-metaworld"
sys.path.append(str(NEIGHBOR))
