"""Formats of videos: one file each, its name is the suffix."""
