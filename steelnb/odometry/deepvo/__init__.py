"""Learned odometry, after DeepVO."""
