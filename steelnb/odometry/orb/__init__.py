"""Visual odometry by ORB features."""
