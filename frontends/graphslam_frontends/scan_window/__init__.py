"""Scan-to-window odometry: each scan is matched to the surfaces of the last seconds."""
