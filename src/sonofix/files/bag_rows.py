"""What numbers of messages become, file by file: its columns, which rows can be used, and why the others cannot."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from sonofix.files.bag_messages import yaw_rad
from sonofix.files.problem import Problem
from sonofix.records import Floats
from sonofix.site import Site

STOOD_M = 0.5
SIDE_MPS = 0.05

Mask = NDArray[np.bool_]


def judge_odometry(
    file: str, name: str, columns: Mapping[str, Floats], notes: list[str], problems: list[Problem]
) -> None:
    """Tell a topic that states poses only, whose speeds of zero would be believed; note speed to the side."""
    v, side, rate = (columns[key][np.isfinite(columns[key])] for key in ("v", "side", "yaw_rate"))
    place = np.column_stack([columns["x"], columns["y"]])
    place = place[np.isfinite(place).all(axis=1)]
    way_m = float(np.linalg.norm(np.ptp(place, axis=0))) if len(place) else 0.0
    if not (np.any(v) or np.any(side) or np.any(rate)) and way_m > STOOD_M:
        remedy = (
            f"is 0 throughout while the pose moves by {way_m:.1f} m: no odometry; leave it out by a --map (as = [])"
        )
        problems.append(Problem(file, f"{name}, twist", None, remedy))
    most = float(np.max(np.abs(side), initial=0.0))
    if most > SIDE_MPS:
        notes.append(
            f"{name}: speed to the side, up to {most:.2f} m/s, is left out; odometry.csv has the speed forward"
        )


def _odometry(site: Site, columns: Mapping[str, Floats], left_out: Counter[str]) -> tuple[dict[str, Floats], Mask]:
    made = {"v_mps": columns["v"], "yaw_rate_radps": columns["yaw_rate"]}
    return made, _kept(left_out, ("not finite", np.isfinite(columns["v"] + columns["yaw_rate"])))


def _imu(site: Site, columns: Mapping[str, Floats], left_out: Counter[str]) -> tuple[dict[str, Floats], Mask]:
    units = {"gx": "radps", "gy": "radps", "gz": "radps", "ax": "mps2", "ay": "mps2", "az": "mps2"}
    made = {f"{n}_{unit}": np.where(np.isfinite(columns[n]), columns[n], np.nan) for n, unit in units.items()}
    some = np.any([np.isfinite(values) for values in made.values()], axis=0)
    return made, _kept(left_out, ("no rate nor acceleration", some))


def _compass(site: Site, columns: Mapping[str, Floats], left_out: Counter[str]) -> tuple[dict[str, Floats], Mask]:
    """Headings from east (REP 145); the site's x axis may be turned against it."""
    heading = yaw_rad(columns) - (site.origin.heading_rad if site.origin else 0.0)
    made = {"heading_rad": np.arctan2(np.sin(heading), np.cos(heading))}
    return made, _kept(left_out, ("no orientation", np.isfinite(heading)))


def _ranges(site: Site, columns: Mapping[str, Floats], left_out: Counter[str]) -> tuple[dict[str, Floats], Mask]:
    """Ranges within their sensor's limits (REP 117: infinite where nothing was found, or too near)."""
    found, least, most, variance = (columns[name] for name in ("range", "least", "most", "variance"))
    limited = (most > 0) & (most >= least)
    inside = ~limited | ((found >= least) & (found <= most))
    signed = site.schedule is not None and not site.schedule.synchronised
    keep = _kept(
        left_out,
        ("not a number", ~np.isnan(found)),
        ("infinite: nothing in reach", ~np.isinf(found)),
        ("outside min_range and max_range", inside),
        ("below 0", (found >= 0) | signed),
    )
    sd_m = np.sqrt(np.where(np.isfinite(variance) & (variance > 0), variance, np.nan))
    return {"range_m": found, "sd_m": sd_m}, keep


def _temperature(site: Site, columns: Mapping[str, Floats], left_out: Counter[str]) -> tuple[dict[str, Floats], Mask]:
    value = columns["temperature"]
    return {"temperature_c": value}, _kept(left_out, ("not from -40 to 60 °C", (value >= -40) & (value <= 60)))


def _truth(site: Site, columns: Mapping[str, Floats], left_out: Counter[str]) -> tuple[dict[str, Floats], Mask]:
    made = {f"{axis}_m": columns[axis] for axis in "xyz"} | {"yaw_rad": yaw_rad(columns)}
    return made, _kept(left_out, ("not finite", np.isfinite(columns["x"] + columns["y"] + columns["z"])))


MAKE: Mapping[str, Callable[[Site, Mapping[str, Floats], Counter[str]], tuple[dict[str, Floats], Mask]]] = {
    "odometry": _odometry,
    "imu": _imu,
    "compass": _compass,
    "ranges": _ranges,
    "temperature": _temperature,
    "truth": _truth,
}
"""By file stem: the columns of its rows from those of messages, and which rows can be used; others are counted."""


def _kept(left_out: Counter[str], *tests: tuple[str, Mask]) -> Mask:
    """Return the rows that pass all tests, and count the others under the first test they fail."""
    keep = np.ones(len(tests[0][1]), bool)
    for reason, passed in tests:
        failed = int(np.count_nonzero(keep & ~passed))
        if failed:
            left_out[reason] += failed
        keep &= passed
    return keep
