"""Monte Carlo localization in offices (ours)."""
