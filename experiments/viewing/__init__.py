"""Pictures and animations of runs and worlds."""
