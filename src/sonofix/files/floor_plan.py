"""Floor plans: walls and obstacles from GeoJSON (RFC 7946), and places for beacons from GeoJSON or CSV.

Coordinates are site metres, east and north of the site's origin, not degrees.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sonofix.files.problem import Problem, RecordingError
from sonofix.files.site_file import read_text
from sonofix.files.tables import Layout, read_table
from sonofix.records import Floats, Walls

MOST_PROBLEMS = 5
"""Told of one file."""

FARTHEST_M = 1e6
"""No site is larger."""

_KINDS = ("LineString", "MultiLineString", "Polygon", "MultiPolygon")


class _Judge:
    """One file while it is read, and what is wrong with it."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.problems: list[Problem] = []

    def tell(self, field: str, value: object, remedy: str) -> None:
        self.problems.append(Problem(self.name, field, value, remedy))

    def check(self) -> None:
        if self.problems:
            raise RecordingError(self.problems[:MOST_PROBLEMS])


def read_walls(path: str | Path) -> Walls:
    """Read the walls and obstacles of a floor plan.

    LineStrings are walls, Polygons obstacles with their holes; a property ``height_m`` says how high they stand, else
    they reach the ceiling. Points are passed over.

    Raises
    ------
    RecordingError
        With the file's mistakes, each with the feature and the field.
    """
    judge = _Judge(Path(path).name or str(path))
    lines: list[tuple[Floats, float, int]] = []
    solids = 0
    for field, geometry, properties in _features(Path(path), judge):
        kind = geometry.get("type")
        if kind in ("Point", "MultiPoint"):
            continue
        if kind not in _KINDS:
            judge.tell(f"{field} geometry.type", kind, f"walls are {', '.join(_KINDS)}")
            continue
        height_m = _height(properties.get("height_m"), field, judge)
        outlines = kind.endswith("Polygon")
        for group in _groups(str(kind), geometry.get("coordinates"), f"{field} coordinates", judge):
            solid = solids if outlines else -1
            solids += outlines
            for line in group:
                points = _points(line, f"{field} coordinates", judge, least=4 if outlines else 2)
                if points is None:
                    continue
                if outlines and np.any(points[0] != points[-1]):
                    judge.tell(f"{field} coordinates", points[-1].tolist(), "an outline ends where it begins")
                lines.append((points, height_m, solid))
    if not lines and not judge.problems:
        judge.tell("", None, "holds no wall; give it a LineString or a Polygon, in site metres")
    judge.check()
    pieces = [len(points) - 1 for points, _, _ in lines]
    return Walls(
        start_m=np.concatenate([points[:-1] for points, _, _ in lines]),
        end_m=np.concatenate([points[1:] for points, _, _ in lines]),
        height_m=np.repeat([height for _, height, _ in lines], pieces),
        solid=np.repeat(np.array([solid for _, _, solid in lines], np.int64), pieces),
    )


def read_places(path: str | Path) -> Floats:
    """Read places where a beacon could be fastened: Points of a GeoJSON file, or a CSV file ``x_m,y_m,z_m``.

    Returns
    -------
    float64 (n, 3)

    Raises
    ------
    RecordingError
        With the file's mistakes.
    """
    path = Path(path)
    columns = ("x_m", "y_m", "z_m")
    if path.suffix.lower() == ".csv":
        table = read_table(path, Layout(columns, given=columns, order=None), None)
        return np.column_stack([table.columns[name] for name in columns])
    judge = _Judge(path.name or str(path))
    found: list[Floats] = []
    for field, geometry, _ in _features(path, judge):
        kind = geometry.get("type")
        if kind not in ("Point", "MultiPoint"):
            continue
        held = geometry.get("coordinates")
        points = _points([held] if kind == "Point" else held, f"{field} coordinates", judge, least=1, size=3)
        if points is not None:
            found.append(points)
    if not found and not judge.problems:
        judge.tell("", None, "holds no place; give it a Point [x, y, z] for each, in site metres")
    judge.check()
    return np.concatenate(found)


def _features(path: Path, judge: _Judge) -> Iterator[tuple[str, Mapping[str, Any], Mapping[str, Any]]]:
    """Yield where, geometry and properties of each feature of a file; collections of geometries are opened."""
    text = read_text(path, path.name or str(path))
    try:
        # whole numbers may be of any length: what no site can hold is a float, infinite at last
        held = json.loads(text, parse_int=lambda digits: int(digits) if len(digits) < 16 else float(digits))
    except (json.JSONDecodeError, RecursionError) as error:
        where = f"line {error.lineno}" if isinstance(error, json.JSONDecodeError) else ""
        why = error.msg if isinstance(error, json.JSONDecodeError) else "nested too deeply"
        judge.tell(where, None, f"not GeoJSON: {why}")
        judge.check()
        return
    kind = held.get("type") if isinstance(held, Mapping) else None
    features = held.get("features") if kind == "FeatureCollection" else [held]
    if kind is None or not isinstance(features, list):
        judge.tell("type", kind, "a floor plan is a GeoJSON FeatureCollection with a list of features")
        judge.check()
        return
    for number, feature in enumerate(features, 1):
        field = f"feature {number}"
        if not isinstance(feature, Mapping):
            judge.tell(field, feature, "a feature is a table with type, geometry and properties")
            continue
        bare = feature.get("type") != "Feature"
        geometry = feature if bare else feature.get("geometry")
        properties = {} if bare else feature.get("properties") or {}
        if geometry is None:  # as the format allows
            continue
        if not isinstance(geometry, Mapping) or not isinstance(properties, Mapping):
            judge.tell(field, None, "geometry and properties are tables in curly brackets")
            continue
        parts = geometry.get("geometries") if geometry.get("type") == "GeometryCollection" else [geometry]
        for part in parts if isinstance(parts, list) else []:
            if isinstance(part, Mapping):
                yield field, part, properties


def _height(value: object, field: str, judge: _Judge) -> float:
    if value is None:
        return math.inf
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value <= FARTHEST_M:
        remedy = f"must be a number above 0 and up to {FARTHEST_M:g}, in m; leave it out for walls to the ceiling"
        judge.tell(f"{field} height_m", value, remedy)
        return math.inf
    return float(value)


def _groups(kind: str, held: object, field: str, judge: _Judge) -> list[Any]:
    """Return coordinates as a list of polygons, each a list of rings; lines likewise, all in one group."""
    groups = {"LineString": [[held]], "MultiPolygon": held}.get(kind, [held])
    if not isinstance(groups, list) or not all(isinstance(group, list) and group for group in groups):
        judge.tell(field, None, "are missing or empty; GeoJSON nests lists of [x, y]")
        return []
    return groups


def _points(line: object, field: str, judge: _Judge, least: int, size: int = 2) -> Floats | None:
    """Return a list of positions as (n, 2 or 3), of which the first ``size`` numbers count."""
    if not isinstance(line, list) or len(line) < least:
        count = len(line) if isinstance(line, list) else 0
        judge.tell(field, None, f"holds {count} points where {least} or more are needed")
        return None
    for point in line:
        numbers = isinstance(point, list) and all(
            isinstance(v, int | float) and not isinstance(v, bool) and abs(v) <= FARTHEST_M for v in point
        )
        if not numbers or len(point) < size:
            judge.tell(
                field,
                point,
                f"a point is {'[x, y, z]' if size == 3 else '[x, y]'}, numbers in m, within {FARTHEST_M:g}",
            )
            return None
    return np.array([point[:size] for point in line], float)
