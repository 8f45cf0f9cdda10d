"""The channel: from a site, motions and air to a made-up recording and the truth about it."""

from sonofix.channel.levels import direct_gains, level_below, noise_for_snr
from sonofix.channel.motion import Circle, Line, Motion, Poses, Sampled, Still
from sonofix.channel.simulate import Tone, simulate
from sonofix.channel.waypoints import Waypoints
from sonofix.channel.wheels import odometry_of

__all__ = [
    "Circle",
    "Line",
    "Motion",
    "Poses",
    "Sampled",
    "Still",
    "Tone",
    "Waypoints",
    "direct_gains",
    "level_below",
    "noise_for_snr",
    "odometry_of",
    "simulate",
]
