"""Write statistics.json from the checkpoint's own processor."""

import json
from pathlib import Path

from safetensors.torch import load_file

HERE = Path(__file__).parent
(file,) = (HERE / "checkpoint").glob("policy_preprocessor_step_*_normalizer_processor.safetensors")
tensors = load_file(file)
rows = {"state": "observation.state", "action": "action"}
found = {
    name: {row: tensors[f"{key}.{row}"].tolist() for row in ("mean", "std", "min", "max") if f"{key}.{row}" in tensors}
    for name, key in rows.items()
}
(HERE / "statistics.json").write_text(json.dumps(found, indent=2) + "\n")
