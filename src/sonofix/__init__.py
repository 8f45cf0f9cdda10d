"""Positioning by sound: from microphone samples to a fused track.

    import sonofix

    recording = sonofix.read_recording("hall")
    for step in sonofix.run(recording):
        for estimate in step.estimates:
            print(estimate.time_s, estimate.vehicle, estimate.position_m, estimate.sd("x"))

Names are loaded when first used, so that importing the package costs next to nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sonofix.channel import simulate
    from sonofix.draw.track import draw_track
    from sonofix.files import RecordingError, read_recording, read_site, read_truth, write_recording, write_run
    from sonofix.flow import run, smoothed
    from sonofix.receiver import Receiver
    from sonofix.score import score_ranges, score_track

__all__ = [
    "Receiver",
    "RecordingError",
    "draw_track",
    "read_recording",
    "read_site",
    "read_truth",
    "run",
    "score_ranges",
    "score_track",
    "simulate",
    "smoothed",
    "write_recording",
    "write_run",
]

_HOMES = {
    "Receiver": "sonofix.receiver",
    "RecordingError": "sonofix.files",
    "draw_track": "sonofix.draw.track",
    "read_recording": "sonofix.files",
    "read_site": "sonofix.files",
    "read_truth": "sonofix.files",
    "run": "sonofix.flow",
    "score_ranges": "sonofix.score",
    "score_track": "sonofix.score",
    "simulate": "sonofix.channel",
    "smoothed": "sonofix.flow",
    "write_recording": "sonofix.files",
    "write_run": "sonofix.files",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'sonofix' has no attribute {name!r}; it offers {', '.join(__all__)}")
    return getattr(import_module(_HOMES[name]), name)
