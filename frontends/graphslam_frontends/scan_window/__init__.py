"""Scan-to-window odometry: each scan on the surfaces of the seconds before it."""
