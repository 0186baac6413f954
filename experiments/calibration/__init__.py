"""Robot parameters from recordings: wheel truth, end poses, real logs."""
