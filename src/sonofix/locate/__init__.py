"""`RangeEpoch` → `Fix`: where a vehicle is by one epoch's ranges alone, and what that rests on."""
