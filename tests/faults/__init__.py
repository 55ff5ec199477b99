"""Faults on purpose: damaged files, hostile folders, a machine that fails."""
