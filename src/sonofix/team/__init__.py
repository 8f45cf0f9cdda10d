"""Several robots that place each other: peer ranges and bearings, odometry, landmarks → joint estimates and roles."""
