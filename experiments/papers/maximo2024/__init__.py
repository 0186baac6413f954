"""Topological Monte Carlo localization."""
