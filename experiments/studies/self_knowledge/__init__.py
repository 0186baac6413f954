"""Whether methods notice that they are lost (ours)."""
