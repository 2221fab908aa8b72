"""The formats of a report, one file each: each draws the blocks of a document, or writes what a program reads."""
