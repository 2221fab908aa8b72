"""Runs the policy on raw observations: tokenises, normalises, infers and brings actions back to physical units."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

MAX_WORDS = 8
PAD = 0
UNKNOWN = 1


def build_vocabulary(sentences: list[str]) -> dict[str, Any]:
    """Numbers every word of the sentences; 0 is padding and 1 an unknown word."""
    words = sorted({word for sentence in sentences for word in sentence.lower().split()})
    numbered = {word: index for index, word in enumerate(words, start=2)}
    return {"kind": "words", "pad": PAD, "unknown": UNKNOWN, "words": numbered}


def tokenise(sentence: str, vocabulary: dict[str, Any]) -> np.ndarray:
    """Turns an instruction into int64 word ids of length 8, padded."""
    known = vocabulary["words"]
    ids = [known.get(word, vocabulary["unknown"]) for word in sentence.lower().split()][:MAX_WORDS]
    return np.array(ids + [vocabulary["pad"]] * (MAX_WORDS - len(ids)), np.int64)


def summarise(values: np.ndarray) -> dict[str, list[float]]:
    """Mean and standard deviation of the last axis, as plain lists."""
    flat = values.reshape(-1, values.shape[-1]).astype(np.float64)
    return {"mean": flat.mean(0).round(8).tolist(), "std": flat.std(0).round(8).tolist()}


class Normaliser:
    """Maps physical values to zero mean and unit variance and back."""

    def __init__(self, statistics: dict[str, list[float]]) -> None:
        self.mean = np.array(statistics["mean"], np.float32)
        self.std = np.array(statistics["std"], np.float32)

    def normalise(self, values: np.ndarray) -> np.ndarray:
        """Physical -> normalised, float32."""
        return ((values - self.mean) / self.std).astype(np.float32)

    def restore(self, values: np.ndarray) -> np.ndarray:
        """Normalised -> physical, float32."""
        return (values * self.std + self.mean).astype(np.float32)


class Runner:
    """A policy with its vocabulary and statistics; called with a raw observation it returns a physical chunk."""

    def __init__(self, policy: nn.Module, vocabulary: dict[str, Any], statistics: dict[str, Any]) -> None:
        self.policy = policy.eval()
        self.vocabulary = vocabulary
        self.proprio = Normaliser(statistics["proprio"])
        self.action = Normaliser(statistics["action"])

    @classmethod
    def load(cls, policy: nn.Module, folder: Path) -> "Runner":
        """Reads vocabulary.json and statistics.json of a folder."""
        vocabulary = json.loads((folder / "vocabulary.json").read_text())
        return cls(policy, vocabulary, json.loads((folder / "statistics.json").read_text()))

    @torch.inference_mode()
    def __call__(self, observation: Any) -> np.ndarray:
        """Observation with `image`, `proprio`, `instruction` -> action chunk (8, 4) in physical units."""
        image = torch.from_numpy(observation["image"])[None]
        proprio = torch.from_numpy(self.proprio.normalise(observation["proprio"]))[None]
        words = torch.from_numpy(tokenise(observation["instruction"], self.vocabulary))[None]
        return self.action.restore(self.policy(image, proprio, words)[0].numpy())
