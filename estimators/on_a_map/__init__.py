"""Localization by a laser in a known map."""
