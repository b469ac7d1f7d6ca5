"""What a recording must be, and the one clear line that says why another is refused."""

from pathlib import Path

import numpy as np
import pytest

from ccdtools import read_disturbance
from ccdtools.exceptions import CCDError, InputError
from ccdtools.vehicles import read_road, read_speed

DT = 0.05


@pytest.fixture
def write(tmp_path):
    def write(text: str | bytes) -> Path:
        path = tmp_path / "file.csv"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


# ── what is read ──


def test_the_only_column_is_the_disturbance(write):
    w = read_disturbance(write("dz_dt\n0.1\n-0.2\n1e-3\n"), dt=DT)
    assert w.dtype == np.float64
    np.testing.assert_array_equal(w, [0.1, -0.2, 1e-3])


@pytest.mark.parametrize("name", ["time", "t"])
def test_a_time_column_is_checked_but_not_taken(write, name):
    w = read_disturbance(write(f"{name},dz_dt\n0,1\n0.05,2\n0.1,3\n"), dt=DT)
    np.testing.assert_array_equal(w, [1, 2, 3])


@pytest.mark.parametrize(
    ("text", "cure"),
    [
        ("time\tw\n0\t1\n0.05\t2\n", "by commas, not tabs"),
        ("time;w\n0;1,5\n0,05;2,5\n", "by commas, not semicolons"),
        ("time [s] w\n0 1\n0.05 2\n", "by commas, not spaces"),
        ("time  w\n0,0   1,5\n0,05  2,5\n", "by commas, not spaces"),
        ("w\n0,1\n0,2\n", "decimals with a point"),
        ('w\n"0,1"\n"0,2"\n', "decimals with a point"),
        ("time,w\n0,0,1,5\n0,05,2,5\n", "decimals with a point"),
        ("time,w\n0,0,1\n0,05,0,2\n", "decimals with a point"),
        ("# of a truck\nw\n1\n2\n", "Remove #"),
        ("w\n1\n# a pause\n2\n", "Remove #"),
    ],
)
def test_another_way_of_writing_a_table_is_told_how_to_write_it(write, text, cure):
    with pytest.raises(InputError, match=cure):
        read_disturbance(write(text), dt=DT)


def test_a_plain_table_is_not_told_to_be_written_otherwise(write):
    with pytest.raises(InputError) as caught:
        read_disturbance(write('time [s],w,note\n0,1,"a;b"\n0.07,2,"c, d"\n'), dt=DT, column="w")
    assert caught.value.cure == f"Resample the file at {DT:g} s."


def test_a_named_column_is_taken_and_the_others_may_hold_text(write):
    path = write("note,left,right\na,1,2\nb,3,4\n")
    np.testing.assert_array_equal(read_disturbance(path, dt=DT, column="right"), [2, 4])


def test_sampling_within_a_thousandth_of_dt_is_accepted(write):
    t = 0.0500028 * np.arange(5)
    text = "\n".join(f"{value!r},0" for value in t.tolist())
    assert len(read_disturbance(write("time,w\n" + text), dt=DT)) == 5


def test_byte_order_mark_windows_line_ends_spaces_and_blank_lines_do_no_harm(write):
    w = read_disturbance(write(b"\xef\xbb\xbf dz_dt \r\n 1 \r\n\r\n2\r\n\r\n"), dt=DT)
    np.testing.assert_array_equal(w, [1, 2])


def test_a_blank_line_among_samples_without_times_is_refused(write):
    with pytest.raises(InputError, match="a blank line 4, expected one row per sample"):
        read_disturbance(write("dz_dt\n1\n2\n\n3\n"), dt=DT)


def test_a_blank_line_among_samples_with_times_does_no_harm(write):
    w = read_disturbance(write("time,dz_dt\n0,1\n0.05,2\n\n0.1,3\n"), dt=DT)
    np.testing.assert_array_equal(w, [1, 2, 3])


def test_the_times_are_not_the_disturbance(write):
    with pytest.raises(InputError, match="column 'time', which holds the times"):
        read_disturbance(write("time,dz_dt\n0,1\n0.05,2\n"), dt=DT, column="time")


def test_speed_is_converted_from_km_per_hour(write):
    time, speed = read_speed(write("time,speed\n0,0\n1,36\n3,72\n"))
    np.testing.assert_array_equal(time, [0, 1, 3])
    np.testing.assert_allclose(speed, [0, 10, 20])


# ── the recorded files of the case study ──


def test_recorded_disturbance_is_read_whole(recorded):
    w = read_disturbance(recorded("dz_dt_mild_driver1.csv"), dt=DT)
    assert w.shape == (17500,)
    assert w[:2] == pytest.approx([0.012599722182960639, 0.01249798330671095])
    assert w[:9000].std() == pytest.approx(0.318, abs=2e-3)
    assert np.abs(w).max() == pytest.approx(3.717, abs=1e-3)


# ── what is refused ──


def read_any_disturbance(path, **keywords):
    return read_disturbance(path, **{"dt": DT} | keywords)


@pytest.mark.parametrize(
    ("read", "argument"), [(read_any_disturbance, "path"), (read_road, "path"), (read_speed, "path")]
)
class TestEveryReader:
    def test_refuses_a_missing_file(self, read, argument, tmp_path):
        with pytest.raises(InputError, match=rf"^{argument}: got .*absent\.csv, which does not exist, exp"):
            read(tmp_path / "absent.csv")

    def test_refuses_a_file_it_cannot_open(self, read, argument, tmp_path):
        with pytest.raises(InputError, match=rf"^{argument}: got .*, which cannot be read \(Is a directory\), exp"):
            read(tmp_path)

    def test_refuses_a_file_that_is_not_text(self, read, argument, write):
        with pytest.raises(InputError, match=rf"^{argument}: got .*not UTF-8 text\), expected a CSV"):
            read(write(b"\xff\xfe\x00\x81"))

    def test_refuses_broken_quoting(self, read, argument, write):
        with pytest.raises(InputError, match=rf"^{argument}: got .*field larger than field limit"):
            read(write("a\n" + '"' + "1" * 200_000))

    @pytest.mark.parametrize("text", ["", "\n\n", " \n,\n"])
    def test_refuses_an_empty_file(self, read, argument, write, text):
        with pytest.raises(InputError, match=rf"^{argument}: got .*, which is empty, expected a CSV file"):
            read(write(text))

    def test_refuses_a_file_without_a_header(self, read, argument, write):
        with pytest.raises(InputError, match=rf"^{argument}: .*: no header, but '0.1', '0.2' in the first line, exp"):
            read(write("0.1,0.2\n0.3,0.4\n0.5,0.6\n"))

    def test_refuses_a_file_with_fewer_than_two_rows(self, read, argument, write):
        with pytest.raises(InputError, match=rf"^{argument}: .*: 1 rows below the header \('a'\), exp"):
            read(write("a\n1\n"))

    def test_refuses_a_ragged_row(self, read, argument, write):
        with pytest.raises(InputError, match=rf"^{argument}: .*: 3 cells in line 3, expected 2 \('a', 'b'\)"):
            read(write("a,b\n1,2\n1,2,3\n"))

    def test_names_the_input_as_told(self, read, argument, tmp_path):
        with pytest.raises(InputError, match=r"^road of the demo: got .*, which does not exist"):
            read(tmp_path / "absent.csv", argument="road of the demo")


@pytest.mark.parametrize("cell", ["", "abc", "nan", "inf", "-inf", "1e999", "1_0"])
def test_a_cell_that_is_no_finite_number_is_refused_with_its_line(write, cell):
    with pytest.raises(InputError, match=rf"^path: got .*: '{cell}' in column 'w', line 4, expected"):
        read_disturbance(write(f"w,x\n1,0\n\n{cell},0\n2,0\n"), dt=DT, column="w")


def test_a_missing_column_is_refused_with_the_columns_found(write):
    path = write("a,b\n1,2\n3,4\n")
    with pytest.raises(InputError, match=r"^path: got .*: no column 'w' among 'a', 'b', expected one"):
        read_disturbance(path, dt=DT, column="w")
    with pytest.raises(InputError, match=r"^path: got .*: no column 'distance' among 'a', 'b', expected"):
        read_road(path)
    with pytest.raises(InputError, match=r"^path: got .*: no column 'time' among 'a', 'b', expected"):
        read_speed(path)


def test_a_column_that_occurs_twice_is_refused(write):
    with pytest.raises(InputError, match="several columns 'speed' among 'time', 'speed', 'speed', expected"):
        read_speed(write("time,speed,speed\n0,1,1\n1,2,2\n"))


def test_a_long_header_is_cut_in_the_message(write):
    header = ",".join(f"c{i}" for i in range(30))
    row = ",".join("1" * 30)
    with pytest.raises(InputError, match=r"'c11', … \(30 columns\), expected") as caught:
        read_road(write(f"{header}\n{row}\n{row}\n"))
    assert "c12" not in str(caught.value)


@pytest.mark.parametrize(("header", "count"), [("a,b", 2), ("time,t", 0)])
def test_without_a_name_the_disturbance_must_be_the_only_column(write, header, count):
    with pytest.raises(InputError, match=rf"{count} columns that could be the disturbance \(.*Name the col"):
        read_disturbance(write(f"{header}\n0,0\n0.05,0.05\n"), dt=DT)


@pytest.mark.parametrize("third", ["0.11", "0.05", "0.01"])
def test_unequal_sampling_is_refused_with_its_line(write, third):
    text = f"time,w\n0,1\n0.05,1\n{third},1\n0.15,1\n0.2,1\n0.25,1\n"
    with pytest.raises(InputError, match=r"unequal sampling: a step of .* s in line 4, expected 0.05 s through"):
        read_disturbance(write(text), dt=DT)


def test_time_that_runs_backwards_is_refused(write):
    with pytest.raises(InputError, match=r"unequal sampling: a step of -0.05 s in line 3"):
        read_disturbance(write("time,w\n0.1,1\n0.05,1\n0.0,1\n"), dt=DT)


def test_another_time_step_is_refused(write):
    with pytest.raises(InputError, match=r"samples every 0.1 s, expected dt = 0.05 s. Resample the file"):
        read_disturbance(write("time,w\n0,1\n0.1,1\n0.2,1\n"), dt=DT)


@pytest.mark.parametrize("dt", [0.0, -1.0, np.nan, np.inf])
def test_a_time_step_that_is_none_is_refused(write, dt):
    with pytest.raises(InputError, match=r"^dt: got .*, expected a positive number \[s\]"):
        read_disturbance(write("w\n1\n2\n"), dt=dt)


@pytest.mark.parametrize("second", ["1", "0.5"])
def test_distance_that_does_not_increase_is_refused(write, second):
    with pytest.raises(InputError, match=rf"column 'distance' going from 1 to {second} in line 3, expected"):
        read_road(write(f"distance,elevation\n1,0\n{second},0\n"))


def test_time_of_a_speed_that_does_not_increase_is_refused(write):
    with pytest.raises(InputError, match="column 'time' going from 1 to 1 in line 4, expected strictly"):
        read_speed(write("time,speed\n0,5\n1,5\n1,5\n"))


def test_a_negative_speed_is_refused(write):
    with pytest.raises(InputError, match=r"^path: got .*: negative speed -2 km/h in line 3, expected speed"):
        read_speed(write("time,speed\n0,5\n1,-2\n"))


def test_a_refusal_is_one_line_and_can_be_caught_as_either_kind(write):
    path = write('"two\nlines",b\n1,2\n3,4\n')
    with pytest.raises(CCDError) as caught:
        read_road(path)
    assert isinstance(caught.value, ValueError)
    assert "\n" not in str(caught.value)
