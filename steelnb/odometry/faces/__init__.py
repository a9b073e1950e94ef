"""Odometry by the front faces of bars."""
