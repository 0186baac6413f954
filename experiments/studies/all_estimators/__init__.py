"""Settings of every estimator: a sweep, whose figures are drawn from its table of means."""
