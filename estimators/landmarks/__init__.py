"""Methods on landmarks seen by a stereo camera."""
