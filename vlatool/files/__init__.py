"""Files and directories: bounded reads, atomic writes, and no change to files that others wrote."""
