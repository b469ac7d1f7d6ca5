"""Rows of a reproduction: what each measures, beside which figure of the paper."""

from __future__ import annotations

from dataclasses import dataclass

from ccdtools.studies.reproduce.paper_figures import PAPER, SETS_AT, SIGNALS, UNPRINTED, Printed

AFRESH = ("penalised", "free", "rmse", "pinball", "r2")  # what every seed meets on a model or a log of its own


@dataclass(frozen=True)
class Line:
    """Row to be filled.

    Attributes
    ----------
    case, key : str
        Study, and name of what was measured.
    says : str
    paper : str
        Key of the paper's figure, if there is one.
    figure : str
        Name of the figure that shows it, if one does.
    lower : bool
        Whether less is better.
    """

    case: str
    key: str
    says: str
    paper: str = ""
    figure: str = ""
    lower: bool = False

    @property
    def printed(self) -> Printed:
        """Figure of the paper."""
        return PAPER[self.case].get(self.paper or self.key, UNPRINTED)

    @property
    def base(self) -> str:
        """Key of LQR at the paper's design, which knows no updates."""
        return self.key.removesuffix("-paper").removesuffix("-updated")

    @property
    def former(self) -> str:
        """Key of generation 1 in a row of generation 2; else empty."""
        name = self.base.removesuffix("-2")
        return "" if name == self.base else f"{name}-1{self.key.removeprefix(self.base)}"

    @property
    def place(self) -> str:
        """Key of the optimum there."""
        return self.key if self.key.startswith("set") else self.base.rpartition("-")[0] or self.base

    @property
    def on_road(self) -> bool:
        """Whether it depends on the road."""
        return self.case == "suspension" and not self.key.startswith(("r2", "nominal", "starts-quiet-1"))

    @property
    def fresh(self) -> bool:
        """Whether each seed draws runs of its own."""
        return self.key.startswith(AFRESH)


def lines_of(case: str) -> list[Line]:
    """Rows of a case study, in the order of the paper."""
    suspension = case == "suspension"
    sets = [Line(case, f"set-{p}", f"area of X_fea at p = {p}", figure="sets") for p in SETS_AT]
    updated = [
        Line(case, f"{name}-{g}", f"return on the updated model, {words} penalty, generation {g}",
             figure="second" if suspension else "")
        for name, words in (("penalised", "with"), ("free", "without")) for g in (1, 2)
    ]  # fmt: skip
    found = [
        *(() if suspension else sets),
        Line(case, "r2", "R² of the clone, by default"),
        Line(case, "r2-paper", "R² of the clone, networks of the preset paper", "r2"),
        Line(case, "nominal-before", "return before the first co-design", "before", "trajectories"),
        Line(case, "nominal-after", "return after it, by default", "after", "first"),
        Line(case, "nominal-after-paper", "return after it, by --preset paper", "after", "first"),
        Line(case, "rmse", "RMSE of the median, all states", figure="quantiles", lower=True),
        Line(case, "pinball", "pinball loss, all states", figure="quantiles", lower=True),
        *updated,
    ]
    return found + (_deployed() if suspension else [])


def _deployed() -> list[Line]:
    """Rows of both generations of the suspension on its real plant."""
    case, generations = "suspension", (1, 2)
    returns = [
        Line(case, f"starts-{place}-{g}{updates}", f"return of 200 starts, {place}, generation {g}, {when} updates",
             f"starts-{g}")
        for place in ("quiet", "road") for updates, when in (("", "before"), ("-updated", "after")) for g in generations
    ]  # fmt: skip
    sigma = [
        Line(case, f"sigma-{i}-{signal}-{g}-updated", f"σ_ss of {signal}, start {i}, generation {g}",
             f"sigma-{i}-{signal}-{g}", "starts", lower=True)
        for i in (1, 2, 3) for signal in SIGNALS for g in generations
    ]  # fmt: skip
    ride = [
        Line(case, f"{name}-{g}-updated", f"{words}, generation {g}", f"{name}-{g}", lower=True)
        for name, words in (("comfort", "weighted body acceleration on the road [m/s²]"),
                            ("effort", "rms force on the road [N]")) for g in generations
    ]  # fmt: skip
    return [*returns, *sigma, *ride]
