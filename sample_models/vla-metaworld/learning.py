"""Supervised learning of the policy: the regression of the expert's chunks."""

import torch
from averaged import AveragedLearner
from batches import Batches, Budget
from policy import VlaPolicy
from torch import Tensor

LEARNING_RATE = 4e-4


class Learner(AveragedLearner):
    """Trains the policy with bfloat16 autocast."""

    def __init__(self, seed: int, budget: Budget) -> None:
        torch.manual_seed(seed)
        policy = VlaPolicy().to(memory_format=torch.channels_last)
        super().__init__(policy, [{"params": list(policy.parameters()), "peak": LEARNING_RATE}], budget)

    def _loss(self, batches: Batches) -> Tensor:
        image, proprio, words, target = batches.draw()
        with torch.autocast("cpu", torch.bfloat16):
            predicted = self.policy(image, proprio, words)
        return ((predicted.float() - target).abs() * self._step_weights).mean()
