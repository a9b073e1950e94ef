"""Odometry by segments, the report's idea."""
