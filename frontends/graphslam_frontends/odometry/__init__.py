"""Motion of the robot: dead reckoning, recorded odometry, steps of scans and motion."""
