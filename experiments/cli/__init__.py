"""The command `estima`: a file a family of commands."""
