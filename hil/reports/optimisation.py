"""The report of an optimisation: the front, all trials, how the search went, and what mattered."""

import warnings
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import plotly.graph_objects as go
from optuna import visualization

from hil.look import BAD, NEUTRAL
from hil.reports.page import LAYOUT, LEGEND, figure_html, overview, write_page
from hil.sweep.design import Design
from hil.sweep.optimisation import RUN, OptimisationResult, Trial, quiet
from hil.sweep.trials import Comparison
from hil.table import Cell, Table

_CHOSEN, _START = BAD, NEUTRAL


def write_report(result: OptimisationResult, chosen: Trial, comparisons: Sequence[Comparison], path: Path) -> None:
    """Write an optimisation, and its check if there is one, as one HTML file.

    Raises:
        InputError: the file cannot be written.
    """
    design = result.design
    names = [each.figure for each in design.objectives]
    with quiet(), warnings.catch_warnings():
        # That importance is of what makes a target small, which is what is asked for.
        warnings.filterwarnings("ignore", message="PedAnova")
        study = _kept(result)
        figures = [
            (
                "trials",
                "All trials within their bounds",
                "A line for each; drag along an axis to pick some.",
                _trials(study, names),
            ),
            ("history", "How the search went", _history_caption(names), _history(study, names)),
            *(
                (f"importance{n}", f"What {name} depends on", _IMPORTANCE, _importance(study, n, name))
                for n, name in enumerate(names)
            ),
        ]
        front = _front(result, study, chosen, names)
    drawn = figure_html("front", "The front", _front_caption(names), front, "view")
    body = overview(_text(result, chosen, comparisons), drawn)
    body += "".join(figure_html(name, title, caption, _styled(figure)) for name, title, caption, figure in figures)
    subtitle = (
        f"{len(result.trials)} trials by {design.method}, {len(study.trials)} of them within their bounds, "
        f"{design.search.seeds} seeds each · gough {version('gough')}"
    )
    write_page(path, f"gough optimise: {design.study.name}", subtitle, body)


_IMPORTANCE = "Share of each factor in what makes a trial one of the best (PED-ANOVA, by Optuna)."


def _kept(result: OptimisationResult) -> optuna.Study:
    """Optuna's study without the trials that break a bound or were given up, which have no figures to draw."""
    study = optuna.create_study(directions=result.study.directions)
    for trial in result.study.get_trials(deepcopy=False):
        if trial.number < len(result.trials) and result.trials[trial.number].state == RUN:
            kept = optuna.trial.create_trial(
                values=trial.values,
                params=trial.params,
                distributions=trial.distributions,
                user_attrs={"trial": trial.number},  # in this study it has another number
            )
            study.add_trial(kept)
    return study


def _front(result: OptimisationResult, study: optuna.Study, chosen: Trial, names: Sequence[str]) -> go.Figure:
    if len(names) not in (2, 3):
        figure = go.Figure(
            go.Parcoords(
                dimensions=[{"label": name, "values": result.objectives_of(result.front)[:, n]} for n, name in enumerate(names)]
            )
        )
        return figure.update_layout(LAYOUT, height=440)
    figure = visualization.plot_pareto_front(study, target_names=list(names))
    marks = [("chosen", result.objectives_of([chosen])[0], _CHOSEN)]
    if result.start:
        marks.append(("as it was", np.array([result.start[name] for name in names]), _START))
    for label, at, color in marks:
        marker = {"size": 11, "color": color, "symbol": "diamond"}
        places = {axis: [value] for axis, value in zip("xyz", at.tolist(), strict=False)}
        kind: Any = go.Scatter if len(names) == 2 else go.Scatter3d
        figure.add_trace(kind(**places, mode="markers", name=label, marker=marker))
    return figure.update_layout(LAYOUT, title=None, height=460, legend=LEGEND)


def _front_caption(names: Sequence[str]) -> str:
    if len(names) == 1:
        return f"The best trial, by {names[0]}."
    return "Trials within their bounds; on the front are those that no other beats in all objectives."


def _trials(study: optuna.Study, names: Sequence[str]) -> go.Figure:
    return visualization.plot_parallel_coordinate(study, target=lambda trial: trial.values[0], target_name=names[0])


def _history(study: optuna.Study, names: Sequence[str]) -> go.Figure:
    if len(names) == 1:
        return visualization.plot_optimization_history(study, target_name=names[0])
    values = np.array([trial.values for trial in study.trials])
    signs = [1.0 if direction == optuna.study.StudyDirection.MINIMIZE else -1.0 for direction in study.directions]
    worst = (values * signs).max(axis=0) * signs
    return visualization.plot_hypervolume_history(study, worst.tolist())


def _history_caption(names: Sequence[str]) -> str:
    if len(names) == 1:
        return f"{names[0]} of each trial within its bounds, and the best until then."
    return "The volume of objectives that the trials beat, from the worst value of each on."


def _importance(study: optuna.Study, number: int, name: str) -> go.Figure:
    # Optuna asks what makes a target small.
    sign = 1.0 if study.directions[number] == optuna.study.StudyDirection.MINIMIZE else -1.0
    return visualization.plot_param_importances(
        study,
        evaluator=optuna.importance.PedAnovaImportanceEvaluator(),
        target=lambda trial: sign * trial.values[number],
        target_name=name,
    )


def _styled(figure: go.Figure) -> go.Figure:
    return figure.update_layout(LAYOUT, title=None, height=380)


def _text(result: OptimisationResult, chosen: Trial, comparisons: Sequence[Comparison]) -> str:
    design = result.design
    table = Table("", "as it was", f"trial {chosen.number}")
    for name in design.pools:
        start = f"{result.start[name]:.4g}" if name in result.start else ""
        table.add(Cell(name, _claim(design, name)), start, f"{chosen.figures[name]:.4g}")
    for name, value in chosen.point.items():
        table.add(name, "", f"{value:.4g}" if isinstance(value, float) else str(value))
    if not comparisons:
        return table.html()
    check = Table(f"check: {comparisons[0].seeds} other seeds", "as it was", "chosen", "better at")
    for each in comparisons:
        values = ", ".join(str(value) for value in each.values.values())
        better = "" if each.better is None else f"{each.better} of {each.seeds}"
        check.add(Cell(each.figure, values), f"{each.start:.4g}", f"{each.chosen:.4g}", better)
    return f"{table.html()}\n{check.html()}"


def _claim(design: Design, name: str) -> str:
    claims = [f"{each.goal}, {_pool(each.pool)}" for each in design.objectives if each.figure == name]
    for each in design.constraints:
        if each.figure == name:
            bounds = [f"{text} {bound}" for text, bound in (("least", each.least), ("most", each.most)) if bound is not None]
            claims.append(", ".join(bounds))
    return "; ".join(claims)


def _pool(pool: str | float) -> str:
    return pool if isinstance(pool, str) else f"{100.0 * pool:g} % quantile"
