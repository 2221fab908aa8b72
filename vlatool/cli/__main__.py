"""``python -m vlatool.cli``."""

from vlatool.cli import main

main()
