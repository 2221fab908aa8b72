"""Combine separate reports into one: ``vlatool compare``."""
