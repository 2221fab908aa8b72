"""Reports that were made apart, as one report: ``vlatool compare``."""
