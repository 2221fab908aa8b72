"""The sections of a report, one file each (``vlatool.render.document``)."""
