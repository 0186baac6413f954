"""Pages, tables and plots of finished studies and sweeps."""
