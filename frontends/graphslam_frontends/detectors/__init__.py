"""Detectors that turn raw scans into landmark observations."""
