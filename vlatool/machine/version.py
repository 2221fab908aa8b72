"""Which version of vlatool this is."""

VERSION = "0.1.0"
