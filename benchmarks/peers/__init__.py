"""Other people's estimators on the recordings that ours runs on: least squares, filterpy's Kalman filter, GTSAM."""
