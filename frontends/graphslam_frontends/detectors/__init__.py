"""Detectors: raw scans in, landmark observations out."""
