"""One least-squares problem of poses, bars and IMU readings."""
