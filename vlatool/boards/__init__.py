"""What a policy would do on a board."""
