"""FastSLAM with stereo landmarks."""
