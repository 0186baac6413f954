"""Real logs (ours)."""
