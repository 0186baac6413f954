"""Worlds: buildings, floor plans, grids, and their files."""
