"""One folder per paper: settings, study, claims, figures, findings."""
