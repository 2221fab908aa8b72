"""Inference libraries behind one small interface; one file each, loaded only when named."""
