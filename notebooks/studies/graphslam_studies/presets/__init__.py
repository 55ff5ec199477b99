"""Recommended settings, ``SOURCE.FRONTEND.toml``."""
