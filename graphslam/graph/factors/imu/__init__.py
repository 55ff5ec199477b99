"""Factors of an inertial measurement unit."""
