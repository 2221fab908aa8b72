"""``python -m vlatool``."""

from vlatool.cli import main

main()
