"""What is installed on this machine, and what it can do."""
