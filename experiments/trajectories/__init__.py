"""Estimates in and out of files."""
