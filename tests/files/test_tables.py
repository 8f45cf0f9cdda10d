from __future__ import annotations

import numpy as np
import pytest

from sonofix.files import RecordingError
from sonofix.files.tables import LAYOUTS, read_table
from sonofix.site import Beacon, Microphone, Site, Vehicle

ONE = Site(
    vehicles=(Vehicle(id="agv"),),
    beacons=(Beacon(id="B1", position_m=(0, 0, 3)), Beacon(id="B2", position_m=(1, 0, 3))),
    microphones=(Microphone(id="M1", vehicle="agv"),),
)
TWO = ONE.model_copy(
    update={
        "vehicles": (Vehicle(id="agv"), Vehicle(id="van")),
        "microphones": (Microphone(id="M1", vehicle="agv"), Microphone(id="M2", vehicle="van")),
    }
)


def read(tmp_path, stem, text, site=ONE):
    path = tmp_path / f"{stem}.csv"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return read_table(path, LAYOUTS[stem], site)


def problems(tmp_path, stem, text, site=ONE) -> list[str]:
    with pytest.raises(RecordingError) as caught:
        read(tmp_path, stem, text, site)
    return [str(problem) for problem in caught.value.problems]


def test_columns_in_any_order_empty_cells_are_nan(tmp_path):
    table = read(tmp_path, "ranges", "to,from,sd_m,time_s,range_m\nM1,B1,,0.5,3.25\nM1,B2,0.1,0.5,-1e-3\n")
    np.testing.assert_array_equal(table.columns["time_s"], [0.5, 0.5])
    np.testing.assert_array_equal(table.columns["range_m"], [3.25, -0.001])
    np.testing.assert_array_equal(table.columns["sd_m"], [np.nan, 0.1])
    assert table.names == {"to": ("M1", "M1"), "from": ("B1", "B2")}


def test_an_only_vehicle_is_filled_in(tmp_path):
    table = read(tmp_path, "odometry", "time_s,v_mps,yaw_rate_radps\n0,1,0\n1,1,0\n")
    assert table.names["vehicle"] == ("agv", "agv")


def test_rows_of_several_vehicles_are_merged_in_time(tmp_path):
    """A file may hold one vehicle after the other; readers downstream get one order of time."""
    text = "time_s,vehicle,heading_rad\n0,agv,0.0\n2,agv,0.2\n1,van,0.1\n3,van,0.3\n"
    table = read(tmp_path, "compass", text, TWO)
    np.testing.assert_array_equal(table.columns["time_s"], [0, 1, 2, 3])
    np.testing.assert_array_equal(table.columns["heading_rad"], [0.0, 0.1, 0.2, 0.3])
    assert table.names["vehicle"] == ("agv", "van", "agv", "van")


def test_equal_times_keep_their_order(tmp_path):
    table = read(tmp_path, "ranges", "time_s,from,to,range_m\n1,B2,M1,2\n1,B1,M1,1\n1,B2,M1,3\n")
    assert table.names["from"] == ("B2", "B1", "B2")


def test_windows_line_ends_quotes_spaces_and_blank_lines(tmp_path):
    table = read(tmp_path, "ranges", b'\xef\xbb\xbftime_s, from, to, range_m\r\n\r\n"0.5", B1 ,M1, 3.0 \r\n\r\n')
    assert table.names["from"] == ("B1",)
    assert table.columns["range_m"].tolist() == [3.0]


def test_line_numbers_are_those_of_the_file(tmp_path):
    (line,) = problems(tmp_path, "compass", "time_s,heading_rad\n\n0,1\n\n\n1,north\n")
    assert line == 'compass.csv: line 6, heading_rad = "north": must be a number with a decimal point'


def test_time_may_go_backwards_between_vehicles_only(tmp_path):
    header = "time_s,vehicle,heading_rad\n"
    read(tmp_path, "compass", header + "5,agv,0\n1,van,0\n", TWO)
    (line,) = problems(tmp_path, "compass", header + "5,agv,0\n1,van,0\n4,agv,0\n", TWO)
    assert "line 4, time_s = 4.0" in line
    assert "of agv" in line


def test_headings_wind_on_but_do_not_jump(tmp_path):
    turning = "time_s,vehicle,heading_rad\n" + "".join(f"{i},agv,{0.5 * i}\n{i},van,{-0.7 * i}\n" for i in range(300))
    assert read(tmp_path, "compass", turning, TWO).columns["heading_rad"].max() == 149.5
    # the van's heading leads on to none of the other's
    told = problems(tmp_path, "compass", turning + "300,agv,-209.5\n", TWO)
    assert len(told) == 1
    assert "line 602, heading_rad" in told[0]
    assert "not degrees" in told[0]


def test_each_unknown_id_is_told_once(tmp_path):
    rows = "".join(f"{i},B{i % 2 + 2},M1,1\n" for i in range(50))
    (line,) = problems(tmp_path, "ranges", "time_s,from,to,range_m\n" + rows)
    assert '"B3"' in line
    assert "known are B1, B2" in line


def test_without_a_site_only_the_form_is_judged(tmp_path):
    table = read(tmp_path, "ranges", "time_s,from,to,range_m\n0,whoever,whom,1\n", site=None)
    assert table.names["from"] == ("whoever",)


@pytest.mark.parametrize("stem", sorted(LAYOUTS))
def test_every_layout_reads_its_own_columns(tmp_path, stem):
    layout = LAYOUTS[stem]
    columns = [*layout.required, *layout.one_of[:1], *layout.optional]
    cell = {"from": "B1", "to": "M1"}
    text = ",".join(columns) + "\n" + ",".join(cell.get(column, "1.5") for column in columns) + "\n"
    table = read(tmp_path, stem, text)
    assert set(table.columns) == set(columns) - {"from", "to"}
    assert all(values.tolist() == [1.5] for values in table.columns.values())


@pytest.mark.parametrize("stem", sorted(LAYOUTS))
def test_every_required_column_is_required(tmp_path, stem):
    layout = LAYOUTS[stem]
    for missing in layout.required:
        columns = [c for c in (*layout.required, *layout.one_of[:1]) if c != missing]
        text = ",".join(columns) + "\n" + ",".join("1.5" for _ in columns) + "\n"
        if columns:
            assert any(f"column {missing} is missing" in line for line in problems(tmp_path, stem, text))
