"""Methods of other projects beside ours, on the same recordings."""
