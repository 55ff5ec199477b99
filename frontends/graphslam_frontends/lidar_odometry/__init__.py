"""LiDAR odometry: each scan of a moving 3-D lidar is matched to the map of the scans before it."""
