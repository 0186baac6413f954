"""Scores, statistics and verdicts; knows trajectories, not configurations."""
