"""Every estimator on the same recordings: a sweep, drawn from its table of means."""
