"""A policy shaped like OpenVLA: a 7 B language model that writes actions as tokens."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vlatool.samples._entries import arm_action, camera, instruction

if TYPE_CHECKING:
    from torch import nn

DESCRIPTION = (
    "Two graphs shaped like OpenVLA: prefill (224x224 camera image through DINOv2-L and SigLIP-SO400M, 32 instruction "
    "tokens, Llama-2-7B) and 6 greedy decoding steps with a key/value cache of fixed size, gives 7 action bins as "
    "float32 in [-1, 1]; 7.5 B parameters: 30 GB in float32, 15 GB in float16."
)
SPEC: dict[str, object] = {
    "inputs": [camera(), instruction(32)],
    "outputs": [arm_action(1)],
    "control_hz": 5,
    "chunk": 1,
}
PROGRAM: list[dict[str, object]] = [
    {
        "graph": "prefill",
        "feeds": {"image": "image", "ids": "instruction"},
        "gives": {"tokens": "tokens", "keys": "keys", "values": "values", "mask": "mask"},
    },
    {
        "graph": "decode",
        "feeds": {"tokens": "tokens", "position": "position", "keys": "keys", "values": "values", "mask": "mask"},
        "gives": {name: name for name in ("action", "tokens_next", "keys_next", "values_next")},
        "repeat": 6,
        "carry": {"tokens_next": "tokens", "keys_next": "keys", "values_next": "values"},
        "schedule": {"position": [0, 1, 2, 3, 4, 5]},
    },
]


def make(seed: int = 0, dtype: str = "float32", device: str | None = None) -> dict[str, nn.Module]:
    """Return the policy in eval mode.

    Args:
        dtype: Name of a floating torch dtype.
        device: Where it lives, the CPU when None; ``"meta"`` costs no memory.

    The two graphs share one language model: 30 GB in float32 and 15 GB in float16 on a real device, one large tensor
    (0.5 GB) more while the weights are drawn, and 0.3 GB for each pair of caches in float32. On the meta device and
    under ``FakeTensorMode`` it costs nothing. A part can be built alone, with the weights that it has in the whole:
    ``build(lambda: DecoderLayer(LLAMA2_7B), seed, prefix="language.decoder.layers.7")``.
    """
    from vlatool.samples._build import build
    from vlatool.samples._openvla import OpenDecode, OpenPrefill, OpenShape

    shape = OpenShape()
    prefill = build(lambda: OpenPrefill(shape), seed, dtype, device)
    return {"prefill": prefill, "decode": OpenDecode(shape, prefill.language).eval()}
