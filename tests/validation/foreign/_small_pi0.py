"""Make pi0 and pi0.5 of LeRobot small: they know two sizes alone, of which the smaller has 1.3 billion weights.

    python _small_pi0.py SCRIPT ARGUMENTS...

Runs a script in which PaliGemma and the action expert have three layers each. Used where a checkpoint is made, and as
the program that ``vlatool --python`` runs (see ``lerobot_checkpoints.py``).
"""

import runpy
import sys

# mypy: ignore-errors

VOCABULARY = 64


def make_small(pi0):
    """Replace the sizes in the module of pi0 or pi0.5."""
    sizes = {"gemma_2b": (64, 3, 128), "gemma_300m": (32, 3, 64)}
    whole, expert = pi0.PaliGemmaForConditionalGenerationWithPiGemma, pi0.PiGemmaForCausalLM

    def language(variant):
        width, depth, hidden = sizes[variant]
        return pi0.GemmaConfig(width, depth, hidden, num_heads=8, num_kv_heads=1, head_dim=16)

    def small_whole(config):
        text, vision = config.text_config, config.vision_config
        text.vocab_size, config._vocab_size, config.image_token_index = VOCABULARY, VOCABULARY, VOCABULARY
        vision.hidden_size, vision.intermediate_size, vision.num_hidden_layers = 48, 96, 2
        vision.num_attention_heads, vision.projection_dim, config.projection_dim = 4, text.hidden_size, text.hidden_size
        return whole(config=config)

    def small_expert(config):
        config.vocab_size = VOCABULARY
        return expert(config=config)

    pi0.get_gemma_config = language
    pi0.PaliGemmaForConditionalGenerationWithPiGemma, pi0.PiGemmaForCausalLM = small_whole, small_expert


if __name__ == "__main__":
    from lerobot.policies.pi0 import modeling_pi0
    from lerobot.policies.pi05 import modeling_pi05

    for module in (modeling_pi0, modeling_pi05):
        make_small(module)
    sys.argv = [word for word in sys.argv[1:] if word != "-I"]
    runpy.run_path(sys.argv[0], run_name="__main__")
