"""Localization methods, one per file: each reads Frames and returns Beliefs."""
