"""Recorded flights through an odometry: as fast as it goes (`run`), at sensor speed (`play`), and what they hold.

Nothing is imported here, so that a command that only asks what a recording holds starts at once.
"""
