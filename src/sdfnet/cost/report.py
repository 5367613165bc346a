"""The studies as one page that opens offline, as a table, as pictures and as a short text."""

import csv
import json
import math
from collections.abc import Mapping, Sequence
from itertools import cycle, pairwise
from pathlib import Path
from typing import Any

import plotly.graph_objects as graph
from jinja2 import Environment, PackageLoader, select_autoescape
from markupsafe import Markup
from matplotlib.figure import Figure
from plotly.offline import get_plotlyjs

from sdfnet.cost.findings import findings_of, front_of, knee_of
from sdfnet.cost.studies import EXACT_MM, Point, Study, Timing, duration_text
from sdfnet.data.store import written_whole

COLOURS = ("#0b6e99", "#d1495b", "#2a9d5c", "#edae49", "#6a4c93", "#8d6b4f", "#00a6a6", "#9a9a9a", "#c06c84", "#3d5a80")


def write_report(folder: Path, title: str, subtitle: str, studies: Sequence[Study], summary: Sequence[str], made_with: Mapping[str, Any]) -> None:
    """Write `report.html`, `points.csv`, `findings.txt` and a picture for each study.

    `summary` are sentences for the top of the page, `made_with` names what it was measured with (versions, threads, load).
    """
    pages = Environment(loader=PackageLoader("sdfnet.cost", ""), autoescape=select_autoescape(default=True), trim_blocks=True)
    shown = [
        {
            "name": study.name,
            "title": study.title,
            "across": study.error_label,
            "up": study.cost_label,
            "findings": findings_of(study),
            "points": [_cells(point) for point in study.points],
        }
        for study in studies
    ]
    figures = ",".join(f'"{study.name}": {_figure(study).to_json()}' for study in studies)
    html = pages.get_template("page.html.j2").render(
        title=title,
        subtitle=subtitle,
        summary=summary,
        studies=shown,
        made_with=made_with,
        plotly=Markup(get_plotlyjs()),  # noqa: S704  plotly's own code, not a user's text
        figures=Markup("{" + figures.replace("</", "<\\/") + "}"),  # noqa: S704  JSON, its only way out of a script closed
    )
    with written_whole(folder / "report.html") as unfinished:
        unfinished.write_text(html)
    with written_whole(folder / "points.csv") as unfinished:
        _write_points(unfinished, studies)
    with written_whole(folder / "findings.txt") as unfinished:
        unfinished.write_text("\n".join(text_of(studies, summary)) + "\n")
    for study in studies:
        with written_whole(folder / f"{study.name}.png") as unfinished:
            _picture(study).savefig(unfinished, format="png", dpi=110)


def text_of(studies: Sequence[Study], summary: Sequence[str]) -> list[str]:
    """The findings of all studies as lines, the summary first."""
    return [*summary, *(line for study in studies for line in ["", study.title, *(f"  {sentence}" for sentence in findings_of(study))])]


def _is_drawn(point: Point) -> bool:
    """Whether it has a place among the others: a reference without error lies far off them on a logarithmic axis."""
    return point.is_measured and not (point.is_reference and point.pair[0] <= EXACT_MM)


def _series(study: Study) -> dict[str, list[Point]]:
    series: dict[str, list[Point]] = {}
    for point in study.points:
        if _is_drawn(point):
            series.setdefault(point.method, []).append(point)
    return {method: sorted(points, key=lambda point: point.pair) for method, points in series.items()}


def _is_curve(points: Sequence[Point]) -> bool:
    """Whether more accuracy costs more all along a series: a line through others would only zigzag."""
    return all(less.pair[1] <= more.pair[1] for more, less in pairwise(points))


def _figure(study: Study) -> graph.Figure:
    """Error across, cost up, both logarithmic: a line a method, the front dashed, a star on the default, a diamond on the knee.

    What the axes show stands above it in the page: on a phone they are too short for the words.
    """
    figure = graph.Figure()
    series, front, bend = _series(study), front_of(study), knee_of(study)
    figure.add_scatter(
        x=[point.pair[0] for point in front], y=[point.pair[1] for point in front],
        mode="lines", name="front", line={"color": "#1c2430", "dash": "dot", "width": 1}, hoverinfo="skip",
    )  # fmt: skip
    for colour, (method, points) in zip(cycle(COLOURS), series.items(), strict=False):
        timings = [point.seconds or Timing.of([point.pair[1]]) for point in points]
        figure.add_scatter(
            x=[point.pair[0] for point in points], y=[point.pair[1] for point in points], name=method,
            mode="lines+markers" if _is_curve(points) else "markers",
            line={"color": colour, "width": 1.5}, marker={"size": 8},
            error_y={"type": "data", "symmetric": False, "thickness": 1, "array": [timing.p95 - timing.median for timing in timings],
                     "arrayminus": [timing.median - timing.p5 for timing in timings]},
            text=[_hover(point) for point in points], hovertemplate="%{text}<extra></extra>",
        )  # fmt: skip
    marked = [(point, "star", "default") for point in study.points if point.is_default and _is_drawn(point)]
    marked += [] if bend is None else [(bend, "diamond-open", "knee")]
    for point, symbol, name in marked:
        figure.add_scatter(
            x=[point.pair[0]], y=[point.pair[1]], mode="markers", name=name, text=[_hover(point)], hovertemplate="%{text}<extra></extra>",
            marker={"symbol": symbol, "size": 17, "color": "#edae49" if name == "default" else "#1c2430", "line": {"width": 1.5, "color": "#1c2430"}},
        )  # fmt: skip
    pairs = [point.pair for points in series.values() for point in points]
    across, up = _axis([error for error, _ in pairs]), _axis([cost for _, cost in pairs])
    figure.update_layout(
        template="plotly_white", margin={"l": 10, "r": 10, "t": 40, "b": 10}, hovermode="closest", xaxis=across, yaxis=up,
        legend={"orientation": "h", "yanchor": "top", "y": -0.1, "x": 0, "font": {"size": 11}},
    )  # fmt: skip
    return figure


def _axis(values: Sequence[float]) -> dict[str, Any]:
    """A logarithmic axis; over one or two decades with labels at 2 and 5, where Plotly would set all nine on top of each other."""
    decades = math.log10(max(values) / min(values)) if values else 0.0
    few = {"dtick": "D2"} if 0.7 < decades < 2.5 else {}
    return {"type": "log", "showgrid": True, "gridcolor": "#e8ecf0", "exponentformat": "power", "automargin": True, **few}


def _picture(study: Study) -> Figure:
    """The same diagram without knee and spread, as a picture for a paper or a README."""
    figure = Figure(figsize=(8, 5), layout="constrained")
    axes = figure.subplots()
    series = _series(study)
    for colour, (method, points) in zip(cycle(COLOURS), series.items(), strict=False):
        axes.plot(
            *zip(*[point.pair for point in points], strict=True), "o-" if _is_curve(points) else "o", color=colour, label=method, markersize=4, linewidth=1
        )
    front = front_of(study)
    if front:
        axes.plot(*zip(*[point.pair for point in front], strict=True), ":", color="#1c2430", linewidth=1, label="front")
    for point in study.points:
        if point.is_default and _is_drawn(point):
            axes.plot(*point.pair, "*", color="#edae49", markeredgecolor="#1c2430", markersize=15, label="default")
    if series:
        axes.set(xscale="log", yscale="log")
        figure.legend(loc="outside right upper", fontsize=7, frameon=False)
    axes.set(xlabel=study.error_label, ylabel=study.cost_label, title=study.title)
    axes.grid(visible=True, which="major", color="#e8ecf0")
    return figure


def _write_points(path: Path, studies: Sequence[Study]) -> None:
    rows = [_row(study, point) for study in studies for point in study.points]
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]) if rows else [])
        writer.writeheader()
        writer.writerows(rows)


def _row(study: Study, point: Point) -> dict[str, Any]:
    """A point for a program to read; what is None is an empty cell."""
    timing = point.seconds
    return {
        "study": study.name,
        "method": point.method,
        "setting": point.setting,
        "error_mm": point.error_mm,
        "seconds": None if timing is None else timing.median,
        "seconds_p5": None if timing is None else timing.p5,
        "seconds_p95": None if timing is None else timing.p95,
        "repeats": None if timing is None else timing.repeats,
        "bytes": point.bytes,
        "counts": json.dumps(dict(point.counts)),
        "is_default": int(point.is_default),
        "is_reference": int(point.is_reference),
        "overrides": " ".join(point.overrides),
        "failure": point.failure,
    }


def _cells(point: Point) -> dict[str, Any]:
    timing = point.seconds
    return {
        "method": point.method,
        "setting": point.setting,
        "is_default": point.is_default,
        "is_reference": point.is_reference,
        "failure": point.failure,
        "error": "not measured" if point.error_mm is None else f"{point.error_mm:.4g}",
        "seconds": "not measured" if timing is None else duration_text(timing.median),
        "spread": _spread(timing),
        "counts": _counts(point),
        "bytes": "" if point.bytes is None else f"{point.bytes:,}",
        "overrides": " ".join(point.overrides),
    }


def _spread(timing: Timing | None) -> str:
    if timing is None or timing.repeats < 2:
        return "one run"
    return f"{duration_text(timing.p5)} to {duration_text(timing.p95)}"


def _counts(point: Point) -> str:
    return ", ".join(f"{name} {count:,}" for name, count in point.counts.items())


def _hover(point: Point) -> str:
    cells = _cells(point)
    size = f"<br>{cells['bytes']} bytes" if cells["bytes"] else ""
    return f"<b>{point.method}</b><br>{point.setting}<br>{cells['error']} mm, {cells['seconds']} ({cells['spread']})<br>{cells['counts']}{size}"
