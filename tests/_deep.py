"""The tiny policy with several blocks, whose weights are drawn: a stack to prune, and to compare with a teacher's."""

from __future__ import annotations

from pathlib import Path

from _tiny import write_policy

LOADED = 'policy.load_state_dict(load_file(str(Path(__file__).with_name("weights.safetensors"))))'


def write_deep(folder: Path, *swaps: tuple[str, str], layers: int = 4, width: int = 16) -> Path:
    """Write the policy into a new folder, with texts of its policy.py swapped: (old, new)."""
    write_policy(folder)
    (folder / "weights.safetensors").unlink()
    drawn = (
        ("    policy = Policy(layers)", "    torch.manual_seed(3)\n    policy = Policy(layers)"),
        (LOADED, "pass"),
        ("layers=1", f"layers={layers}"),
        ("WIDTH = 16", f"WIDTH = {width}"),
    )
    code = (folder / "policy.py").read_text()
    for old, new in (*drawn, *swaps):
        assert old in code, f"{old} is not in policy.py"
        code = code.replace(old, new)
    (folder / "policy.py").write_text(code)
    described = (folder / "policy.yaml").read_text()
    (folder / "policy.yaml").write_text(described.replace("arguments: {layers: 1}", f"arguments: {{layers: {layers}}}"))
    return folder
