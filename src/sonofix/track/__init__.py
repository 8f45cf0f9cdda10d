"""`RangeEpoch` or `Fix`, and motion → `Estimate`: the track between and beyond single epochs."""
