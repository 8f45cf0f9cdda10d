"""From estimates and truth to figures.

``score_ranges`` and ``score_track`` take plain columns; ``range_columns`` and ``track_columns`` make these of the steps
of a run.
"""

from sonofix.score.columns import RangeColumns, TrackColumns, range_columns, track_columns
from sonofix.score.innovations import InnovationFigures, score_innovations
from sonofix.score.poses import heard_range_m, node_position_m, pose_at
from sonofix.score.ranges import ErrorFigures, RangeFigures, score_ranges
from sonofix.score.track import TrackFigures, score_track

__all__ = [
    "ErrorFigures",
    "InnovationFigures",
    "RangeColumns",
    "RangeFigures",
    "TrackColumns",
    "TrackFigures",
    "heard_range_m",
    "node_position_m",
    "pose_at",
    "range_columns",
    "score_innovations",
    "score_ranges",
    "score_track",
    "track_columns",
]
