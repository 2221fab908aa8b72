"""Files and directories: read with limits, written whole, never somebody else's."""
