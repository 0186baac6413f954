"""From a configuration to rows: the experiment, the one runner, the cache."""
