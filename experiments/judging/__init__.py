"""What all studies use: results on disk, parallel jobs, claims and verdicts."""
