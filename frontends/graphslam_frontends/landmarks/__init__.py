"""Landmark front ends: local maps by RBPF-EKF (FastSLAM 1.0 and 2.0), by EKF, and from 3-D points."""
