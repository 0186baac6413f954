"""Localization methods: one a file, each reads Frames and answers with Beliefs."""
