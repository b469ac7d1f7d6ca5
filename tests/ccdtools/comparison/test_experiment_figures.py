"""Pictures, pages and files of an experiment."""

import csv
import json

import numpy as np
import pytest
from scalar_experiment import GAIN, LAWS, OBJECTIVE, PLANT, drawn, found, stopping

from ccdtools import InputError, LinearFeedback, QuadraticObjective, Scenario, compare, experiment, plant_from_matrices
from ccdtools.controllers import Passive
from ccdtools.plants.library import dc_servo


def test_the_figure_says_what_was_not_made_and_hides_no_curve():
    def refused(design, rng):
        raise InputError("gains", "none", "a stable loop")

    gains, profile, _ = found(LAWS | {"same": LAWS["LQR"], "PID": refused}).plot().axes
    (low, high), rows = gains.get_ylim(), gains.get_yticks()
    assert high < rows.min() < rows.max() < low
    assert [text.get_text() for text in gains.texts] == ["not made"]
    assert gains.texts[0].get_position()[1] == rows[2]
    shown = {line.get_label(): line.get_linestyle() for line in profile.lines}
    assert list(shown) == ["LQR", "learned", "same", "PID: not made"]
    assert shown["LQR"] == "-" != shown["same"]


def test_the_figure_has_a_row_where_every_controller_stops():
    dead = Scenario(stopping(3.0), [[1.0], [2.0]], [[0.0], [9.0], [0.0]])
    gains, *_ = found(scenarios={"good": drawn, "dead": dead}, seeds=2).plot().axes
    assert [text.get_text() for text in gains.get_yticklabels()] == ["learned, good", "learned, dead"]
    assert [(text.get_text(), text.get_position()[1]) for text in gains.texts] == [("open", 1)]
    only = found(scenarios=dead, seeds=2).plot().axes[1]
    assert [" ".join(line.get_label().split()) for line in only.lines] == [f"{name}: no run ended" for name in LAWS]


def apart(figure):
    """Whether no two labels beside an axis overlap, and no axes and the legend."""
    figure.draw_without_rendering()
    groups = [[one.get_window_extent() for one in ax.get_yticklabels()] for ax in figure.axes]
    groups.append([ax.get_tightbbox() for ax in figure.axes] + [one.get_window_extent() for one in figure.legends])
    return not any(a.overlaps(b) for group in groups for i, a in enumerate(group) for b in group[:i])


@pytest.mark.long
@pytest.mark.parametrize("laws", [2, 12])
def test_long_names_do_not_overlap_in_the_figures(laws):
    names = [f"nonlinear MPC with a Kalman filter, imitated, number {i}" for i in range(laws)]
    start = Scenario(PLANT, np.ones((4, 1)), np.zeros((4, 5, 1)))
    result = found(dict.fromkeys(names, LAWS["LQR"]), {"calm": start, "windy": start}, seeds=1)
    assert apart(result.plot())
    table = compare({name: LinearFeedback([[GAIN]]) for name in names}, start, objective=OBJECTIVE, X=([-50], [50]))
    assert apart(table.plot().figure)


@pytest.mark.long
def test_a_page_says_what_was_compared(tmp_path):
    class Law:
        """A law of the user's own, without a repr."""

        def __call__(self, x):
            return -0.1 * x

    def own(x):
        return -0.3 * x

    laws = {"LQR": LAWS["LQR"], "own": lambda p, rng: own, "object": lambda p, rng: Law(),
            "late": lambda p, rng: Passive(1)}  # fmt: skip
    start = Scenario(PLANT, [[1.0], [2.0]], np.zeros((2, 15, 1)), output=[[1.0]])
    plants = {"nominal": PLANT, "faster": plant_from_matrices([[0.5]], [[1.0]], [[1.0]], dt=1.0, continuous=False)}
    result = found(
        laws, {"from rest": drawn, "from afar": start}, plants=plants, seeds=[3, 5], folder=tmp_path / "kept"
    )
    lines = result.header.lines
    assert [line[:2] for line in lines] == [
        ("plant", "nominal"), ("plant", "faster"), ("scenario", "from rest"), ("scenario", "from afar"),
        ("objective", ""), ("X", ""), ("U", ""), ("seeds", ""), *(("controller", name) for name in laws),
    ]  # fmt: skip
    words = {line[:2]: line[2] for line in lines}
    assert words["plant", "faster"] == repr(plants["faster"])
    assert words["scenario", "from rest"] == "7 runs of 15 steps of 1 s"
    assert words["scenario", "from afar"].startswith("2 runs of 15 steps of 1 s, Measurement(")
    assert words["objective", ""] == "QuadraticObjective(Q=[1.0], R=[0.5])"
    assert words["X", ""] == "[-50.0] to [50.0]"
    assert words["seeds", ""] == "3, 5"
    assert "own" in words["controller", "own"]
    assert "Law object" in words["controller", "object"]
    assert " at 0x" not in repr(lines)
    assert found(laws, {"from rest": drawn, "from afar": start}, plants=plants, seeds=[3, 5],
                 folder=tmp_path / "kept").header == result.header  # fmt: skip
    result.save(tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert page.index("what was compared") < page.index("data:image/png")
    space = dc_servo()
    other = Scenario(space, [[0.5, 0.0]], np.zeros((1, 30, space.nw)))
    gain = {"gain": lambda p, rng: LinearFeedback([[1.0, 0.1]])}
    given = {"objective": QuadraticObjective(np.eye(2), [[0.1]]), "X": ([-9, -99], [9, 99]), "seeds": 1}
    told = experiment(gain, other, designs={"middle": space.design.centre}, **given).header.lines
    assert ("design", "middle", space.design.describe(space.design.centre)) in told


def test_rows_are_saved_as_csv_parquet_and_a_page(tmp_path):
    pandas = pytest.importorskip("pandas")
    result = found(seeds=2)
    result.save(tmp_path / "rows.csv")
    with (tmp_path / "rows.csv").open() as stream:
        read = list(csv.DictReader(stream))
    assert [float(row["return"]) for row in read] == [row["return"] for row in result.rows()]
    pytest.importorskip("pyarrow")
    result.save(tmp_path / "rows.parquet")
    assert pandas.read_parquet(tmp_path / "rows.parquet").equals(result.to_frame())
    result.save(tmp_path / "page.html")
    assert "data:image/png" in (tmp_path / "page.html").read_text()
    json.dumps(result.rows())


def test_a_path_of_no_known_kind_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"path: got .*rows\.txt"):
        found(seeds=1).save(tmp_path / "rows.txt")
