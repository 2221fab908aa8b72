"""Files and directories: bounded reads, atomic writes, and no change to files of other owners."""
