"""LiDAR odometry: where each scan of a moving 3-D lidar lies in the map of the scans before it."""
