"""The regression gate: suites, baselines, comparison, planted faults, estimator conformance."""
