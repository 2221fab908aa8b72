"""Accuracy of a policy: losses, success, paired episodes, and the credibility of the reference."""
