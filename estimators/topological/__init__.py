"""Localization among the places of a topological map."""
