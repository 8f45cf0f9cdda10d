"""Planning: what a layout of beacons promises before anything has sounded."""
