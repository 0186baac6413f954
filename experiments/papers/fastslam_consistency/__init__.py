"""Consistency of FastSLAM (ours)."""
