"""Methods on laser scans: registration, its covariance, and what fuses it with the wheels."""
