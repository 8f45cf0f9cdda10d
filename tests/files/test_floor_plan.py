"""Floor plans and places: what is read, and what is told of mistakes."""

from __future__ import annotations

import json

import numpy as np
import pytest

from sonofix.files import RecordingError
from sonofix.files.floor_plan import read_places, read_walls

SQUARE = [[0, 0], [4, 0], [4, 4], [0, 4], [0, 0]]


def written(folder, held, name: str = "plan.geojson"):
    path = folder / name
    path.write_text(held if isinstance(held, str) else json.dumps(held), "utf-8")
    return path


def feature(kind: str, coordinates, **properties) -> dict:
    return {
        "type": "Feature",
        "properties": properties or None,
        "geometry": {"type": kind, "coordinates": coordinates},
    }


def plan(*features) -> dict:
    return {"type": "FeatureCollection", "features": list(features)}


def test_lines_and_outlines_become_pieces(tmp_path) -> None:
    walls = read_walls(
        written(
            tmp_path,
            plan(
                feature("LineString", [[0, 0], [5, 0], [5, 5.5]], height_m=2.5),
                feature("Polygon", [SQUARE, [[1, 1], [2, 1], [2, 2], [1, 1]]], name="shelf", height_m=3),
                feature("MultiLineString", [[[7, 0], [7, 1]], [[8, 0], [8, 1, 99.0]]]),
                feature("MultiPolygon", [[SQUARE], [SQUARE]]),
                feature("Point", [1, 1]),
                {"type": "Feature", "properties": {}, "geometry": None},
            ),
        )
    )
    assert len(walls) == 2 + (4 + 3) + 2 + 8
    assert walls.solid.tolist() == [-1] * 2 + [0] * 7 + [-1] * 2 + [1] * 4 + [2] * 4
    assert walls.height_m.tolist() == [2.5] * 2 + [3.0] * 7 + [np.inf] * 10
    np.testing.assert_array_equal(walls.end_m[1], [5.0, 5.5])
    np.testing.assert_array_equal(walls.start_m[2:6], SQUARE[:-1])
    np.testing.assert_array_equal(walls.end_m[10], [8.0, 1.0])


def test_a_bare_geometry_and_a_collection_are_taken(tmp_path) -> None:
    line = {"type": "LineString", "coordinates": [[0, 0], [1, 0]]}
    assert len(read_walls(written(tmp_path, line))) == 1
    many = {"type": "Feature", "properties": {"height_m": 2}, "geometry": None}
    many["geometry"] = {"type": "GeometryCollection", "geometries": [line, line]}
    walls = read_walls(written(tmp_path, many))
    assert walls.height_m.tolist() == [2.0, 2.0]


@pytest.mark.parametrize(
    ("held", "message"),
    [
        ("{", r"plan.geojson: line 1: not GeoJSON"),
        ({"features": []}, r"plan.geojson: type: a floor plan is a GeoJSON FeatureCollection"),
        ([1, 2], r"plan.geojson: type: a floor plan"),
        (plan(), r"holds no wall"),
        (plan(feature("Point", [1, 2])), r"holds no wall"),
        (plan("wall"), r"feature 1 = \"wall\": a feature is a table"),
        (plan(feature("Circle", [1, 2])), r"feature 1 geometry.type = \"Circle\": walls are LineString"),
        (plan(feature("LineString", [[0, 0]])), r"feature 1 coordinates: holds 1 points where 2 or more"),
        (plan(feature("LineString", None)), r"feature 1 coordinates: holds 0 points"),
        (plan(feature("LineString", [[0, 0], [1, "a"]])), r"feature 1 coordinates = \[1, 'a'\]: a point is \[x, y\]"),
        (plan(feature("LineString", [[0, 0], [1]])), r"a point is \[x, y\]"),
        ('{"type": "LineString", "coordinates": [[0, 0], [1, NaN]]}', r"a point is \[x, y\], numbers"),
        (plan(feature("Polygon", [SQUARE[:-1]])), r"= \[0.0, 4.0\]: an outline ends where it begins"),
        (plan(feature("Polygon", [])), r"feature 1 coordinates: are missing or empty"),
        (plan(feature("Polygon", SQUARE)), r"feature 1 coordinates"),
        (plan(feature("LineString", SQUARE, height_m="high")), r"feature 1 height_m = \"high\": must be a number"),
        (plan(feature("LineString", SQUARE, height_m=0)), r"feature 1 height_m = 0: must be a number above 0"),
        (plan(feature("LineString", SQUARE, height_m=True)), r"feature 1 height_m = true: must be a number"),
        (plan(feature("LineString", SQUARE, height_m=10**400)), r"feature 1 height_m = inf: must be a number above 0"),
        (plan(feature("LineString", [[0, 0], [10**400, 1]])), r"= \[inf, 1\]: a point is \[x, y\], numbers in m"),
        (plan(feature("LineString", [[0, 0], [1, -(10**20)]])), r"numbers in m, within 1e\+06"),
        ('{"type": "LineString", "coordinates": [[0, 0], [1, ' + 5000 * "9" + "]]}", r"= \[1, inf\]: a point"),
        ('{"type": "LineString", "coordinates": [[0, 0], [1, 1e999]]}', r"= \[1, inf\]: a point"),
        ('{"type": ' + 5000 * "9" + "}", r"geometry.type|feature 1"),
    ],
)
def test_mistakes_name_feature_field_value_and_remedy(tmp_path, held, message) -> None:
    with pytest.raises(RecordingError, match=message):
        read_walls(written(tmp_path, held))


def test_all_mistakes_are_told_up_to_five(tmp_path) -> None:
    with pytest.raises(RecordingError) as caught:
        read_walls(written(tmp_path, plan(*[feature("Circle", [])] * 9)))
    assert len(caught.value.problems) == 5


def test_a_file_that_is_not_there_is_told(tmp_path) -> None:
    with pytest.raises(RecordingError, match="there is no such file"):
        read_walls(tmp_path / "none.geojson")


def test_places_come_from_points_or_a_table(tmp_path) -> None:
    points = plan(feature("Point", [1, 2, 3]), feature("MultiPoint", [[4, 5, 6], [7, 8, 9]]), feature("Polygon", []))
    found = read_places(written(tmp_path, points))
    np.testing.assert_array_equal(found, [[1, 2, 3], [4, 5, 6], [7, 8, 9]])
    table = written(tmp_path, "x_m,y_m,z_m\n1,2,3\n4,5,6\n7,8,9\n", "places.csv")
    np.testing.assert_array_equal(read_places(table), found)


def test_places_without_height_or_at_all_are_told(tmp_path) -> None:
    with pytest.raises(RecordingError, match=r"feature 1 coordinates = \[1, 2\]: a point is \[x, y, z\]"):
        read_places(written(tmp_path, plan(feature("Point", [1, 2]))))
    with pytest.raises(RecordingError, match="holds no place"):
        read_places(written(tmp_path, plan(feature("LineString", [[0, 0], [1, 1]]))))
    with pytest.raises(RecordingError, match="column z_m is missing"):
        read_places(written(tmp_path, "x_m,y_m\n1,2\n", "places.csv"))
