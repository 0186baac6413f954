"""Exploration: what gil2008 expects of robots that share out where to go."""
