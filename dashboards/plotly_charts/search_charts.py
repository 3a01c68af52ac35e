"""Charts of a search: its progress, the importance of the settings, the front, and the objectives by each setting."""

from __future__ import annotations

from dashboards.analysis.searches import SearchedTrial, SearchSummary, setting_text, value_text
from dashboards.plotly_charts.chart import Chart, Choice, Figure, Panel, Table, View, layout

TRIAL, BEST = "--fixed", "--transfer"


def progress_chart(search: SearchSummary) -> Chart:
    """The values of all trials in their order, and the best so far: a panel for each objective."""
    panels = [Panel(name, _progress(search, place), wide=True) for place, name in enumerate(search.objectives)]
    note = "Each point is a trial; the line is the best value so far. A search's best value is biased upwards: "
    note += "judge it again on episodes that the search has not played."
    return Chart("search", "Progress", note, [], {"": View(panels, trials_table(search))})


def importances_chart(search: SearchSummary) -> Chart:
    """The share of each objective's variance that each setting explains."""
    panels = [
        Panel(name, _importances(shares)) for name, shares in zip(search.objectives, search.importances, strict=True)
    ]
    rows = [
        (name, *(f"{100 * shares[name]:.1f} %" if name in shares else "–" for shares in search.importances))
        for name in search.names
    ]
    table = Table(("setting", *search.objectives), rows)
    note = "The share of the objective's variance that a setting explains alone and with others (fANOVA)."
    views = {"": View(panels, table)} if any(search.importances) else {}
    return Chart("importances", "Importance of the settings", note, [], views)


def front_chart(search: SearchSummary) -> Chart:
    """The trials by every pair of objectives, and the front; without views for one objective."""
    pairs = [(a, b) for a in range(len(search.objectives)) for b in range(a + 1, len(search.objectives))]
    panels = [
        Panel(f"{search.objectives[b]} against {search.objectives[a]}", _front(search, a, b), wide=True)
        for a, b in pairs
    ]
    front = [trial for trial in search.complete if trial.number in search.front]
    views = {"": View(panels, _table(search, front))} if panels else {}
    note = "On the front are the trials that no other trial betters in all objectives."
    return Chart("front", "Front", note, [], views)


def slices_chart(search: SearchSummary) -> Chart:
    """Every objective by one setting."""
    views = {
        name: View(
            [Panel(objective, _slice(search, name, place)) for place, objective in enumerate(search.objectives)],
            trials_table(search),
        )
        for name in search.names
    }
    choices = [Choice("setting", "Setting", [(name, name) for name in views], next(iter(views)))] if views else []
    return Chart("slices", "By setting", "Each point is a complete trial.", choices, views)


def trials_table(search: SearchSummary) -> Table:
    """All trials: number, state, values, settings."""
    return _table(search, search.trials)


def _table(search: SearchSummary, trials: list[SearchedTrial]) -> Table:
    rows = []
    for trial in trials:
        values = [value_text(*pair) for pair in zip(search.objectives, trial.values, strict=False)]
        values += ["–"] * (len(search.objectives) - len(values))
        settings = [setting_text(trial.settings[name]) if name in trial.settings else "–" for name in search.names]
        rows.append((str(trial.number), trial.reason or trial.state, *values, *settings))
    return Table(("trial", "state", *search.objectives, *search.names), rows)


def _hover(search: SearchSummary, trial: SearchedTrial) -> str:
    values = [f"{name} {value_text(name, value)}" for name, value in zip(search.objectives, trial.values, strict=True)]
    settings = [f"{name} {setting_text(value)}" for name, value in trial.settings.items()]
    return "<br>".join((f"trial {trial.number}", *values, *settings))


def _points(search: SearchSummary, x: list[object], y: list[float]) -> Figure:
    return {
        "type": "scatter",
        "mode": "markers",
        "name": "trial",
        "x": x,
        "y": y,
        "customdata": [_hover(search, trial) for trial in search.complete],
        "hovertemplate": "%{customdata}<extra></extra>",
        "marker": {"color": TRIAL, "size": 8},
    }


def _line(x: list[float], y: list[float], name: str, shape: str) -> Figure:
    line = {"color": BEST, "width": 2, "shape": shape}
    return {"type": "scatter", "mode": "lines", "name": name, "x": x, "y": y, "line": line, "hoverinfo": "skip"}


def _progress(search: SearchSummary, place: int) -> Figure:
    best = search.best_so_far(place)
    numbers: list[object] = [trial.number for trial in search.complete]
    points = _points(search, numbers, [trial.values[place] for trial in search.complete])
    line = _line([float(n) for n, _ in best], [value for _, value in best], "best so far", "hv")
    return {"data": [points, line], "layout": layout(xaxis={"title": {"text": "trial"}}, yaxis={"zeroline": False})}


def _importances(shares: dict[str, float]) -> Figure:
    ordered = sorted(shares.items(), key=lambda item: item[1])
    bars = {
        "type": "bar",
        "orientation": "h",
        "x": [share for _, share in ordered],
        "y": [name for name, _ in ordered],
        "hovertemplate": "%{y} %{x:.1%}<extra></extra>",
        "marker": {"color": TRIAL},
    }
    axis = {"range": [0.0, 1.0], "tickformat": ".0%", "fixedrange": True}
    return {"data": [bars], "layout": layout(xaxis=axis, yaxis={"automargin": True, "fixedrange": True})}


def _front(search: SearchSummary, a: int, b: int) -> Figure:
    front = sorted((trial.values[a], trial.values[b]) for trial in search.complete if trial.number in search.front)
    xs: list[object] = [trial.values[a] for trial in search.complete]
    points = _points(search, xs, [trial.values[b] for trial in search.complete])
    line = _line([x for x, _ in front], [y for _, y in front], "front", "linear")
    axes = {"xaxis": {"title": {"text": search.objectives[a]}}, "yaxis": {"title": {"text": search.objectives[b]}}}
    return {"data": [points, line], "layout": layout(**axes)}


def _slice(search: SearchSummary, name: str, place: int) -> Figure:
    xs: list[object] = [trial.settings[name] for trial in search.complete]
    points = _points(search, xs, [trial.values[place] for trial in search.complete])
    axis = {"title": {"text": name}, "type": "log" if name in search.logarithmic else "-"}
    return {"data": [points], "layout": layout(xaxis=axis, yaxis={"zeroline": False})}
