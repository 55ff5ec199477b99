"""Layer 1: registration of scans and submaps: relative pose, its covariance, and other possible poses."""
