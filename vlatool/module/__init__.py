"""The torch side of a policy: its description, its factory, its modules."""
