"""Landmark front ends: RBPF-EKF (FastSLAM 1.0 and 2.0) local maps."""
