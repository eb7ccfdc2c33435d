"""Depth from images."""
