"""Pruning methods: remove the least important parts of a policy before it is exported."""
