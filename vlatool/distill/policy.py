"""Distillation: a policy is trained on what a teacher would do, without an expert."""

from __future__ import annotations

from vlatool.training.imitation import ImitationStage


class PolicyDistillation(ImitationStage):
    """Train a policy to do what a teacher does, on recordings and, where it names an environment, on episodes.

    The teacher is the policy as it was before any edit, so that this recovers what pruning lost; or another bundle. No
    expert is needed: first the teacher acts, then again and again the student, and the teacher says what it would have
    done wherever they came to (DAgger: Ross et al., arXiv 1011.0686).
    """
