"""One folder a paper: settings, study, claims, figures, findings."""
