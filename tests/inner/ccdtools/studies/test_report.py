"""The report of small but real runs: a two-state study, and one with other dimensions throughout."""

import copy
import csv
import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from markupsafe import escape
from matplotlib.figure import Figure
from two_masses import two_masses

from ccdtools import CVaR, Plant, QuadraticObjective, figure_style as style
from ccdtools.evidence.percent import number
from ccdtools.exceptions import InputError
from ccdtools.studies import RunFolder, load_study
from ccdtools.studies.report.finished_run import FinishedRun
from ccdtools.studies.report.gains import gain_text
from ccdtools.studies.report.headline import headline
from ccdtools.studies.report.landscape import draw_curve, draw_path
from ccdtools.studies.report.report import render, write_report
from ccdtools.studies.report.tables import console_table


def rows_of(folder, name):
    """The rows of a CSV file."""
    with (folder.path / name).open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def figures_of(folder):
    """Names of the figures."""
    return {path.stem for path in (folder.path / "figures").glob("*.png")}


def test_two_state_study_has_every_figure(spring):
    assert figures_of(spring[0]) == {
        "changes", "history", "landscape", "comparison", "feasible_sets", "policy", "trajectories_model",
        "trajectories_real",
        "quantiles_1", "quantiles_2",
    }  # fmt: skip


@pytest.mark.long
def test_figures_that_a_study_cannot_have_are_left_out(masses):
    assert figures_of(masses[0]) == {
        "changes", "history", "comparison", "feasible_sets", "trajectories_model", "trajectories_real", "quantiles_1",
    }  # fmt: skip


def test_page_holds_every_figure_and_links_to_nothing(spring, masses):
    for folder, _ in (spring, masses):
        page = (folder.path / "report.html").read_text(encoding="utf-8")
        assert page.count("data:image/png;base64,") == len(figures_of(folder))
        assert not re.search(r"""(src|href)\s*=\s*["'](?!data:)|https?://|@import|<script""", page)
        text = re.sub(r"base64,[^\"]*", "", page)
        assert "None" not in text
        assert "nan" not in text


def test_quick_is_marked_in_every_output(spring, masses):
    for (folder, results), marked in ((spring, True), (masses, False)):
        page = (folder.path / "report.html").read_text(encoding="utf-8")
        assert ("QUICK" in page) == marked
        assert ("QUICK" in console_table(results)) == marked
        for name in ("comparison.csv", "generations.csv", "learning_curves.csv"):
            assert {row["mode"] for row in rows_of(folder, name)} == {"QUICK" if marked else "full"}
    assert [text.get_text() for text in style.blank(4, 3, quick=True).texts] == ["QUICK"]
    assert not style.blank(4, 3).texts


def key(row):
    """The block of a row."""
    return row["plant"], row["generation"]


def test_tables_repeat_the_results(spring, masses):
    for folder, results in (spring, masses):
        comparison = rows_of(folder, "comparison.csv")
        assert len(comparison) == len(results["comparison"])
        lqr = {key(row): row["n"] for row in results["comparison"] if row["controller"] == "LQR"}
        for row, source in zip(comparison, results["comparison"]):
            assert row["controller"] == source["controller"]
            few = source["controller"].startswith("MPC") and source["n"] < lqr[key(source)]
            assert row["mean"] == ("" if few or source["mean"] is None else str(source["mean"]))
            assert all(float(row[name]) == value for name, value in source["design"].items())
        generations = rows_of(folder, "generations.csv")
        assert [float(row["deployed_return_mean"]) for row in generations] == [
            g["deployed_return"]["mean"] for g in results["generations"]
        ]


def test_learning_curves_have_one_row_per_evaluation(spring):
    folder, results = spring
    curves = rows_of(folder, "learning_curves.csv")
    for generation in results["generations"]:
        g = generation["generation"]
        history = folder.read_stage(f"codesign-{g}").arrays
        own = [row for row in curves if row["generation"] == str(g)]
        assert [float(row["model_return"]) for row in own] == history["history_model_return"].tolist()
        assert [float(row["k"]) for row in own] == history["history_design"][:, 0].tolist()


def test_page_names_designs_with_units_and_active_bounds(masses):
    folder, results = masses
    page = (folder.path / "report.html").read_text(encoding="utf-8")
    assert "k = 1 N/m, c = 0.5 N·s/m, d = 0.5 N·s/m" in page
    assert "k lower" in page
    assert "<td>pathwise</td>" in page
    assert json.dumps(results["configuration"]["codesign"]["design_rate"]) in page


def test_console_table_is_aligned_and_names_active_bounds(masses):
    text = console_table(masses[1])
    lines = text.splitlines()
    heading = next(line for line in lines if line.startswith("plant"))
    assert "active bounds: k lower" in text
    body = [line for line in lines if re.match(r"(nominal model|replayed errors|real plant) +\d", line)]
    assert len(body) == len(masses[1]["comparison"])
    edge = heading.index("controller")
    assert all(line[edge - 2 : edge] == "  " and line[edge] != " " for line in body)


@pytest.mark.check
def test_a_page_can_be_written_again(spring, tmp_path):
    folder = RunFolder(shutil.copytree(spring[0].path, tmp_path / "run"))
    study = load_study(spring[0].path.parent / "spring.py")
    before = (folder.path / "report.html").read_text(encoding="utf-8")
    write_report(replace(study, filter="admissible", limit_tolerance=(0.0, 0.0)), folder)
    assert (folder.path / "report.html").read_text(encoding="utf-8") == before


def test_every_decision_stands_on_the_page_with_all_its_evidence(spring):
    folder, results = spring
    page = (folder.path / "report.html").read_text(encoding="utf-8")
    table = page[page.index('<details id="decisions">') : page.index('<details id="sets">')]
    shown = [re.sub(r"<.*?>", "", cell).strip() for cell in re.findall(r"<td.*?</td>", table, flags=re.S)]
    said = []
    for generation in results["generations"]:
        decisions = [*generation["online_updates"], *((generation["redesign"] or {}).get("decisions") or {}).values()]
        said += [one["percent"] for decision in [*decisions, generation["delivery"]] for one in decision["evidence"]]
    assert len(said) > 4
    assert [cell for cell in shown if cell in said] == said


@pytest.mark.long
def test_the_report_is_imported_without_torch():
    code = "import sys, ccdtools.studies.report.report; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_folder_without_results_is_an_error(tmp_path):
    with pytest.raises(InputError, match=r"without a readable results\.json"):
        write_report(load_study("illustrative"), RunFolder(tmp_path))


def test_mpc_stands_beside_lqr_on_the_runs_that_both_saw(spring):
    text = console_table(spring[1])
    rows = [row for row in spring[1]["comparison"] if row["controller"] in ("MPC", "LQR")][:2]
    mpc, lqr = sorted(rows, key=lambda row: row["n"])
    shared = mpc["mean"] - mpc["paired_to_lqr"]["mean"]
    assert mpc["n"] < lqr["n"]
    means = f"mean {number(mpc['mean'])}, of LQR on these {number(shared)}"
    assert f"first {mpc['n']} of {lqr['n']} runs, {means}" in text
    assert "MPC *" in text


def test_the_headline_comes_first(spring):
    folder, results = spring
    page = (folder.path / "report.html").read_text(encoding="utf-8")
    assert page.lower().index("real plant: cost") < page.index("What changed") < page.index("Where the gain comes from")
    assert results["headline"].startswith("QUICK run, not a result. ")


def test_the_page_says_how_many_updates_were_accepted_and_states_the_problem(spring):
    folder, results = spring
    page = (folder.path / "report.html").read_text(encoding="utf-8")
    for generation in results["generations"]:
        updates = generation["online_updates"]
        assert f"{sum(u['accepted'] for u in updates)} of {len(updates)} updates of the deployed policy" in page
    assert "Q, diagonal: x1: 1.000, x2: 1.000" in page
    assert "quantile loss (pinball loss)" in page


def test_the_redesign_is_reported_whether_taken_or_not(spring):
    folder, results = spring
    redesign = results["generations"][1]["redesign"]
    assert results["generations"][0]["redesign"] is None
    assert redesign["texts"]
    page = (folder.path / "report.html").read_text(encoding="utf-8")
    assert str(escape(redesign["texts"][0].replace("-", "−")[1:])) in page


def test_predicted_and_deployed_return_stand_side_by_side(spring):
    folder, results = spring
    page = (folder.path / "report.html").read_text(encoding="utf-8")
    with (folder.path / "generations.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    for generation, row in zip(results["generations"], rows):
        assert row["account"] == generation["account"]
        assert str(escape(generation["account"][1:])) in page
        assert float(row["predicted_return_mean"]) == generation["predicted_return"]["mean"]
        assert row["agreement"] == generation["delivery"]["agreement"]
    first, second = results["generations"]
    assert first["delivery"]["status"] == "the first deployed"
    assert second["delivery"]["former"] == 1
    assert second["delivery"]["paired"]


def test_a_generation_has_one_colour_in_every_figure():
    colours = [style.generation_colour(g) for g in range(len(style.GENERATIONS))]
    assert len(set(colours) | set(style.COLOURS.values())) == len(colours) + len(style.COLOURS)


def test_a_controller_keeps_its_colour_and_strangers_get_their_own():
    colours = style.controller_colours(["LQR", "learned", "tube MPC", "H∞"])
    assert colours["LQR"] == style.COLOURS["LQR"]
    assert len({colours[name] for name in ("LQR", "learned", "tube MPC", "H∞")}) == 4


def test_landscape_of_nothing_but_divergence_is_still_drawn():
    for fine in (False, True):
        figure = Figure()
        ax = figure.add_subplot()
        mean = np.full((3, 3), -1.0 if fine else np.nan)
        axis = np.linspace(0, 1, 3)
        style.draw_map(ax, axis, axis, mean, np.full((3, 3), fine), label="return")
        draw_path(ax, np.array([0.1, 0.5]), np.array([0.1, 0.5]), 0, line="-")
        assert style.png(figure).startswith(b"\x89PNG")
    figure = Figure()
    ax = figure.add_subplot()
    nothing = np.full(3, np.nan)
    draw_curve(ax, axis, nothing, nothing, np.zeros(3, dtype=bool), whole=False)
    draw_path(ax, axis, nothing, 0, line="none")
    assert style.png(figure).startswith(b"\x89PNG")


def test_every_table_shows_how_far_outside_X_beside_how_often(spring):
    folder, results = spring
    assert all(0 <= row["depth_mean"] <= row["depth_peak"] <= row["depth_worst"] for row in results["comparison"]
               if row["depth_peak"] is not None)  # fmt: skip
    text = console_table(results)
    assert text.index("outside X") < text.index("depth") < text.index("µs/step")
    header = (folder.path / "comparison.csv").read_text(encoding="utf-8").splitlines()[0].split(",")
    assert {"violations", "depth_mean", "depth_peak", "depth_worst", "exceeded", "further_outside_than"} <= set(header)
    assert "<th>outside X</th><th>depth</th>" in (folder.path / "report.html").read_text(encoding="utf-8")


def test_held_out_roads_stand_beside_the_deployed_drive_with_the_gains_by_source(masses):
    folder, results = masses
    page = (folder.path / "report.html").read_text(encoding="utf-8")
    assert [place["place"] for place in results["gains"]] == ["deployed drive", "fresh draws", "the study's start"]
    of = [{row["controller"] for row in results["held_out"] if row["generation"] == g} for g in (0, 1)]
    assert of[0] == {"passive", "LQR", "PID", "MPC", "learned"}
    assert of[1] == of[0] | {"LQR, identified", "MPC, offset-free"}  # which know the log
    assert {row["generation"] for row in results["held_out"]} == {0, 1}
    assert "fresh draws (5 runs of 300 steps)" in page
    assert "generation 1, learned" in page
    for place in results["gains"]:
        parts = [place[source]["mean"] for source in ("design", "policy", "updates", "redesign")]
        assert sum(parts) == pytest.approx(place["total"]["mean"], abs=1e-9 * abs(place["start"]))
        assert f"{place['place']} (" in console_table(results)
        assert gain_text(place, "total") in page
    assert "elsewhere: " in results["headline"]
    assert len(rows_of(folder, "held_out.csv")) == len(results["held_out"])
    assert len(rows_of(folder, "gains.csv")) == 5 * len(results["gains"])


def test_the_gain_on_the_deployed_drive_is_that_of_its_rows(masses):
    results = masses[1]
    rows = {(row["generation"], row["controller"]): row for row in results["comparison"] if row["plant"] == "real"}
    drive = results["gains"][0]
    assert drive["start"] == pytest.approx(rows[0, "LQR"]["mean"])
    assert drive["design"]["mean"] == pytest.approx(rows[1, "LQR"]["mean"] - rows[0, "LQR"]["mean"])
    assert drive["total"]["mean"] == pytest.approx(rows[1, "learned"]["mean"] - rows[0, "LQR"]["mean"])


def test_a_place_that_no_generation_has_met_is_said_and_that_there_is_none(spring):
    folder, results = spring
    assert {row["plant"] for row in results["held_out"]} == {"held out: the study's start"}
    assert [place["place"] for place in results["gains"]] == ["real plant", "the study's start"]
    page = (folder.path / "report.html").read_text(encoding="utf-8")
    assert "the other columns are disturbances that no generation has met" in page
    without = results | {"gains": results["gains"][:1], "held_out": []}
    page = render(FinishedRun(load_study(folder.path.parent / "spring.py"), folder, without), [])
    assert "the runs on the real plant are fresh in every comparison" in page


def test_a_gain_without_an_interval_or_without_a_reference_says_so():
    place = {"start": -50.0, "total": {"mean": 5.0, "ci95": [None, None]}, "design": {"mean": None, "ci95": [None] * 2}}
    assert gain_text(place, "total") == "+10 % [no interval]"
    assert gain_text(place, "design") == "n/a"
    assert gain_text(place | {"start": 0.0}, "total") == "n/a"


def test_a_run_that_began_with_mpc_or_identified_its_plant_says_so(spring):
    folder, results = spring
    told = {
        "initialisation": {"expert": "nonlinear MPC", "samples": 12, "seconds": 1.0},
        "generations": [one | {"identified": "the logs tell gain 0.5 ± 0.1"} for one in results["generations"]],
    }
    page = render(FinishedRun(load_study(folder.path.parent / "spring.py"), folder, results | told), [])
    assert "the first policy imitates nonlinear MPC of the model, on 12 samples" in page
    assert page.count("The logs tell gain 0.5 ± 0.1.") == len(results["generations"])


def test_the_page_states_cross_weight_risk_and_limits_of_outputs(masses):
    """As the same run of another study would have it: the page is made of the study and its results."""
    folder, results = masses
    study = two_masses()
    plant = study.plant
    limited = Plant(
        plant.x, plant.u, plant.w, plant.p, plant.dynamics, plant.design, dt=plant.dt, state_names=plant.state_names,
        input_names=plant.input_names, outputs=[plant.u[0] - plant.x[1], plant.x[0], plant.x[2]],
        output_names=["slip [m/s]", "free [m]", "travel [m]"],
        output_limits=([-np.inf, -np.inf, -0.7654], [1.2345, np.inf, 0.9]),
    )  # fmt: skip
    S = np.zeros((4, 2))
    S[1, 0] = -0.01234
    other = replace(study, plant=limited, objective=QuadraticObjective(np.eye(4), 0.1 * np.eye(2), S), risk=CVaR(0.35))
    page = {one: render(FinishedRun(one, folder, results), []) for one in (study, other)}
    told = [
        "S: [0, 0; −0.01234, 0; 0, 0; 0, 0]",
        "uᵀRu + 2zᵀSu",
        "Of the returns a co-design optimises the mean of the worst 35 %",
        "<td>slip [m/s]</td><td>n/a</td><td>1.234</td>",
        "<td>travel [m]</td><td>−0.7654</td><td>0.9000</td>",
    ]
    for text in told:
        assert text in page[other]
        assert text not in page[study]
    assert "free [m]" not in page[other]


@pytest.mark.parametrize(("interval", "unsure"), [((0.08, 0.12), ""), ((None, None), " (without an interval)")])
def test_the_headline_names_the_best_other_law_where_it_costs_less_than_lqr(spring, interval, unsure):
    results = copy.deepcopy(spring[1])
    last = len(results["generations"])
    lqr = next(row for row in results["comparison"]
               if (row["plant"], row["generation"], row["controller"]) == ("real", last, "LQR"))  # fmt: skip
    size = abs(lqr["lqr_mean"])
    ends = [None if end is None else end * size for end in interval]
    gain = lqr["paired_to_lqr"] | {"mean": 0.1 * size, "ci95": ends}
    results["comparison"].append(lqr | {"controller": "mine", "paired_to_lqr": gain, "design_cost": 0.0})
    said = headline(results)
    assert f"the best other law (mine) 10 % less{unsure}" in said
    assert ("(without an interval)" in said) == bool(unsure)
