"""Storey 0: geometry, Gaussians, sensor records and the submap contract. Imports nothing above it."""
