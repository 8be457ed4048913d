"""The figures of a log's page, drawn by plotly."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import plotly.graph_objects as graphs
from plotly.colors import qualitative
from plotly.offline import get_plotlyjs
from plotly.subplots import make_subplots

from companion.analysis import Analysis
from companion.decode import dimension_of
from companion.events import Json
from companion.picture import History
from companion.report.readings import Array, Curve, Readings

MOST_POINTS: Final = 4000  # of one curve: a screen has no more, and a telephone no patience
MOST_MESSAGES: Final = 25
MOST_SOURCES: Final = 8
LEAST_SHARE: Final = 1e-3  # of a threshold: the lower end of a logarithmic axis
ROW_PX: Final = 26
PANEL_PX: Final = 150
PALETTE: Final[Sequence[str]] = qualitative.D3
STATUS_COLOURS: Final = {"ok": "#2e7d32", "warning": "#b26a00", "fault": "#c62828", "not_available": "#777777"}
KIND_COLOURS: Final = {
    "fault": "#c62828",
    "recovery": "#1565c0",
    "vehicle": "#555555",
    "link": "#6a1b9a",
    "check": "#b26a00",
    "self": "#00838f",
}
MARKED: Final = {  # events drawn through the figures of numbers too: (kind, name) -> colour
    ("fault", "detected"): "#ef6c00",
    ("fault", "isolated"): "#c62828",
    ("recovery", "acknowledged"): "#1565c0",
    ("recovery", "verified"): "#2e7d32",
    ("recovery", "rolled_back"): "#6a1b9a",
}
BAND: Final = 11  # width of a band, px


def script() -> str:
    """plotly's own JavaScript, to be put into the page."""
    return str(get_plotlyjs())


def all_of(analysis: Analysis, history: History, readings: Readings) -> list[tuple[str, str]]:
    """(heading, HTML) of each figure, in the order of the page; those without anything to show are left out."""
    drawn = [("Timeline", timeline(analysis))]  # the figures over one clock have one range
    if analysis.replay is not None and history.t_s:
        detector = analysis.replay.airframe.detector
        t_s = np.array(history.t_s)
        shares = np.maximum(np.array(history.residuals) / history.thresholds, LEAST_SHARE)
        signals = np.array(history.signals)
        drawn.append(("Residuals: above 1 is beyond the threshold", _residuals(analysis, t_s, shares, detector.residuals)))
        drawn.append(("Asked for and flown", _signals(analysis, t_s, signals, detector.signals)))
    drawn.append(("Link: frames a second by source", _link(readings)))
    drawn.append(("Sensors", _sensors(readings)))
    if readings.clock == "vehicle clock":
        for _, figure in drawn:
            if figure is not None:
                figure.update_xaxes(range=readings.span)
    drawn.append(("Messages of the log", _messages(analysis)))
    return [(heading, _html(figure)) for heading, figure in drawn if figure is not None]


def _html(figure: Any) -> str:
    config = {"responsive": True, "displaylogo": False, "modeBarButtonsToRemove": ["select2d", "lasso2d"]}
    return str(figure.to_html(full_html=False, include_plotlyjs=False, config=config, default_width="100%"))


def thinned(t_s: Array, value: Array) -> tuple[Array, Array]:
    """At most MOST_POINTS points: of each stretch the smallest and the largest, so that no peak is lost.

    A stretch in which nothing is known stays unknown.
    """
    if len(t_s) <= MOST_POINTS:
        return t_s, value
    length = -(-len(t_s) // (MOST_POINTS // 2))
    stretches = -(-len(t_s) // length)
    padded = np.full(stretches * length, math.nan)
    padded[: len(value)] = value
    blocks = padded.reshape(stretches, length)
    known = np.isfinite(blocks)
    base = np.arange(stretches) * length
    low = base + np.where(known, blocks, math.inf).argmin(axis=1)
    high = base + np.where(known, blocks, -math.inf).argmax(axis=1)
    picks = np.unique(np.concatenate((low, high)))
    return t_s[picks], value[picks]


def rows_of(value: Json) -> Sequence[Mapping[str, Json]]:
    """The objects of a JSON list; none for anything else."""
    return [row for row in value if isinstance(row, dict)] if isinstance(value, list) else []


def _laid_out(figure: Any, height: int, *, clock: str = "vehicle clock", legend: bool = True) -> Any:
    figure.update_layout(
        height=height,
        margin={"l": 8, "r": 12, "t": 34, "b": 8},  # the buttons of a figure stand in the margin above it
        legend={"orientation": "h", "y": -60.0 / height, "yanchor": "top", "x": 0.0, "font": {"size": 11}},
        showlegend=legend,
        template="plotly_white",
        hovermode="closest",
        font={"size": 12},
    )
    figure.update_xaxes(automargin=True, title={"text": f"{clock}, s", "standoff": 4} if clock else None)
    figure.update_yaxes(automargin=True)
    return figure


def timeline(analysis: Analysis) -> Any:
    """Bands for armed, modes and the checks that found something; marks for events, a row for each kind of them."""
    figure = graphs.Figure()
    order: list[str] = []
    _armed(figure, analysis, order)
    _modes(figure, analysis, order)
    groups: dict[tuple[str, str], list[Mapping[str, Json]]] = {}
    for line in rows_of(analysis.content["events"]):
        if line["t"] is not None and line["kind"] in KIND_COLOURS and line["name"] not in ("mode", "armed", "disarmed"):
            groups.setdefault((str(line["kind"]), str(line["name"])), []).append(line)
    for kind, colour in KIND_COLOURS.items():
        for (group, name), lines in groups.items():
            if group == kind:
                order.append(f"{kind}: {name.replace('_', ' ')}")
                _marks(figure, order[-1], lines, colour)
    for check in rows_of(analysis.content["checks"]):
        spans = check.get("spans")
        if check["status"] in ("warning", "fault") and isinstance(spans, list) and spans:
            order.append(f"check: {check['id']}")
            colour = STATUS_COLOURS[str(check["status"])]
            found = [(float(str(span[0])), float(str(span[1]))) for span in spans if isinstance(span, list)]
            _band(figure, order[-1], found, colour, str(check["text"]))
    if not order:
        return None
    _laid_out(figure, 70 + ROW_PX * len(order), legend=False)
    figure.update_yaxes(categoryorder="array", categoryarray=order[::-1], fixedrange=True, tickfont={"size": 11})
    figure.update_yaxes(range=[-0.7, len(order) - 0.3])
    return figure


def _armed(figure: Any, analysis: Analysis, order: list[str]) -> None:
    if analysis.flight.armed_spans and analysis.flight.clocked:
        order.append("armed")
        _band(figure, "armed", analysis.flight.armed_spans, "#90a4ae", "armed")


def _modes(figure: Any, analysis: Analysis, order: list[str]) -> None:
    """A band in which each mode has its colour, and its name where there is room."""
    flight = analysis.flight
    if not flight.modes or not flight.clocked:
        return
    order.append("mode")
    ends = [t_s for t_s, _ in flight.modes[1:]] + [max(flight.t_s, flight.modes[-1][0])]
    colours: dict[str, str] = {}
    whole_s = max(ends[-1] - flight.modes[0][0], 1e-9)
    for (start_s, name), end_s in zip(flight.modes, ends, strict=True):
        colour = colours.setdefault(name, PALETTE[len(colours) % len(PALETTE)])
        _band(figure, "mode", [(start_s, end_s)], colour, name)
        if (end_s - start_s) / whole_s > 0.02 + 0.025 * len(name):
            figure.add_annotation(
                x=0.5 * (start_s + end_s), y="mode", text=name, showarrow=False, font={"size": 10, "color": "#ffffff"}
            )


def _band(figure: Any, row: str, spans: Sequence[tuple[float, float]], colour: str, text: str) -> None:
    """Spans as thick lines; a span without length as a mark, which a line would not show."""
    x: list[float | None] = []
    for start_s, end_s in spans:
        x += [start_s, end_s, None]
    line = {"width": BAND, "color": colour}
    figure.add_scatter(x=x, y=[row] * len(x), mode="lines", line=line, text=text, hoverinfo="x+text")
    points = [start_s for start_s, end_s in spans if end_s - start_s < 0.5]
    marker = {"size": BAND, "color": colour, "symbol": "line-ns-open", "line": {"width": 3}}
    figure.add_scatter(x=points, y=[row] * len(points), mode="markers", marker=marker, text=text, hoverinfo="x+text")


def _marks(figure: Any, row: str, lines: Sequence[Mapping[str, Json]], colour: str) -> None:
    text = [str(line["text"]) for line in lines]
    marker = {"color": colour, "size": 11, "symbol": "diamond", "line": {"color": "#ffffff", "width": 1}}
    t_s = [line["t"] for line in lines]
    figure.add_scatter(x=t_s, y=[row] * len(lines), mode="markers", marker=marker, text=text, hoverinfo="x+text")


def _mark_events(figure: Any, analysis: Analysis) -> None:
    """Lines through a figure of numbers where something was found or done; what they are stands above, one under another."""
    seen: list[float] = []
    for line in rows_of(analysis.content["events"]):
        colour = MARKED.get((str(line["kind"]), str(line["name"])))
        t = line["t"]
        if colour is None or not isinstance(t, float):
            continue
        figure.add_vline(x=t, line={"color": colour, "width": 1.5, "dash": "dot"})
        label = {"size": 10, "color": colour}
        name = str(line["name"]).replace("_", " ")
        figure.add_annotation(
            x=t,
            xref="x",
            y=0.98 - 0.075 * (len(seen) % 5),
            yref="paper",
            text=name,
            font=label,
            showarrow=False,
            xanchor="left",
            bgcolor="rgba(255,255,255,0.7)",
            borderpad=1,
        )
        seen.append(t)


def _add_curves(figure: Any, curves: Sequence[Curve]) -> None:
    for place, curve in enumerate(curves):
        t_s, value = thinned(curve.t_s, curve.value)
        figure.add_scatter(
            x=t_s.tolist(),
            y=_known(value),
            mode="lines",
            name=_label(curve.name),
            line={"width": 1.5, "color": PALETTE[place % len(PALETTE)]},
        )


def _label(name: str) -> str:
    """ "turn_rate_rad_s" -> "turn rate, rad/s"."""
    suffix = dimension_of(name)
    if suffix == "1":
        return name.replace("_", " ")
    return f"{name.removesuffix('_' + suffix).replace('_', ' ')}, {suffix.replace('_', '/', 1).replace('s2', 's²')}"


def _known(value: Array) -> list[float | None]:
    """Numbers to six digits, which no screen exceeds: half the page's size."""
    return [float(f"{number:.6g}") if math.isfinite(number) else None for number in value.tolist()]


def _residuals(analysis: Analysis, t_s: Array, shares: Array, names: Sequence[str]) -> Any:
    figure = graphs.Figure()
    _add_curves(figure, [Curve(name, t_s, shares[:, place]) for place, name in enumerate(names)])
    figure.update_yaxes(type="log", title={"text": "share of the threshold", "standoff": 4})
    figure.add_hline(y=1.0, line={"dash": "dash", "color": "#222222", "width": 1.5})
    _mark_events(figure, analysis)
    return _laid_out(figure, 460)


def _signals(analysis: Analysis, t_s: Array, signals: Array, names: Sequence[str]) -> Any:
    figure = graphs.Figure()
    _add_curves(figure, [Curve(name, t_s, signals[:, place]) for place, name in enumerate(names)])
    _mark_events(figure, analysis)
    return _laid_out(figure, 360)


def _link(readings: Readings) -> Any:
    if not readings.rates:
        return None
    figure = graphs.Figure()
    _add_curves(figure, readings.rates[:MOST_SOURCES])
    for start_s, end_s in readings.gaps:
        figure.add_vrect(x0=start_s, x1=end_s, fillcolor="#c62828", opacity=0.2, line_width=0)
    if readings.gaps:
        longest_s = max(end_s - start_s for start_s, end_s in readings.gaps)
        text = f"red: nothing of the vehicle, {len(readings.gaps)} time(s), longest {longest_s:.0f} s"
        figure.add_annotation(
            x=0, xref="paper", y=0, yref="paper", text=text, showarrow=False, xanchor="left", yanchor="bottom"
        )
    figure.update_yaxes(rangemode="tozero", title={"text": "frames/s", "standoff": 4})
    figure = _laid_out(figure, 340, clock=readings.clock)
    return figure.update_layout(showlegend=True)


def _sensors(readings: Readings) -> Any:
    """One panel under another on one axis of time; the title of each names its curves in their colours."""
    count = len(readings.panels)
    if not count:
        return None
    titles = []
    for panel in readings.panels:
        names = [f"<span style='color:{PALETTE[place]}'>{curve.name}</span>" for place, curve in enumerate(panel.curves)]
        titles.append(f"{panel.title}: {', '.join(names)}")
    height = 60 + PANEL_PX * count
    figure = make_subplots(
        rows=count, cols=1, shared_xaxes=True, subplot_titles=titles, vertical_spacing=34 / height if count > 1 else 0.0
    )
    for row, panel in enumerate(readings.panels, start=1):
        for place, curve in enumerate(panel.curves):
            t_s, value = thinned(curve.t_s, curve.value)
            line = {"width": 1.5, "color": PALETTE[place]}
            figure.add_scatter(x=t_s.tolist(), y=_known(value), mode="lines", name=curve.name, line=line, row=row, col=1)
    _laid_out(figure, height, clock="", legend=False)
    figure.update_layout(margin={"t": 56})
    figure.update_annotations(font={"size": 12})
    figure.update_xaxes(title={"text": f"{readings.clock}, s", "standoff": 4}, row=count, col=1)
    return figure


def _messages(analysis: Analysis) -> Any:
    reader = analysis.content["reader"]
    messages = reader["messages"] if isinstance(reader, dict) else {}
    counted = sorted(messages.items(), key=lambda item: int(str(item[1]))) if isinstance(messages, dict) else []
    if not counted:
        return None
    most = counted[-MOST_MESSAGES:]
    names, counts = [name for name, _ in most], [int(str(count)) for _, count in most]
    figure = graphs.Figure(graphs.Bar(x=counts, y=names, orientation="h", text=counts, marker={"color": "#78909c"}))
    figure.update_yaxes(tickfont={"size": 10}, fixedrange=True)
    return _laid_out(figure, 60 + 20 * len(most), clock="", legend=False)
