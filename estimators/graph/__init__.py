"""Methods by sparse least squares over a drive."""
