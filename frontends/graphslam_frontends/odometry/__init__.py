"""Motion of the robot: dead reckoning, recorded odometry, and steps (motion and beams at common stamps)."""
