"""A log's page: one self-contained HTML file with what happened, when, and how the numbers stood.  Needs the extra `report`.

Drawn from the same analysis that the JSON comes from.  Everything is inside the file, so that it opens without a network,
on a telephone too.
"""

import html
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from companion.analysis import Analysis
from companion.errors import UserError
from companion.events import Json
from companion.picture import History

MOST_POINTS: Final = 4000  # of one curve: a screen has no more, and a telephone no patience
STATUS_COLOURS: Final = {"ok": "#2e7d32", "warning": "#e69500", "fault": "#c62828", "not_available": "#777777"}
EVENT_COLOURS: Final = {
    "fault": "#c62828",
    "recovery": "#1565c0",
    "vehicle": "#555555",
    "link": "#6a1b9a",
    "check": "#e69500",
}
STYLE: Final = """
body{font-family:system-ui,sans-serif;margin:0 auto;max-width:70rem;padding:1rem;color:#222;background:#fff}
h1{font-size:1.3rem;overflow-wrap:anywhere}h2{font-size:1.1rem;margin-top:2rem}
table{border-collapse:collapse;width:100%;font-size:.9rem}
td,th{border-bottom:1px solid #ddd;padding:.3rem .5rem;text-align:left;
vertical-align:top;overflow-wrap:anywhere}
.verdict{font-size:1.2rem;font-weight:600;padding:.5rem .8rem;border-radius:.4rem;color:#fff}
.wide{overflow-x:auto}
"""
VERDICT_COLOURS: Final = {"healthy": "#2e7d32", "fault": "#c62828", "degraded": "#e69500", "not_judged": "#777777"}


@dataclass(frozen=True, slots=True)
class Curve:
    """One line of a figure."""

    name: str
    t_s: np.ndarray
    value: np.ndarray


def thinned(t_s: np.ndarray, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """At most MOST_POINTS points: of each stretch the smallest and the largest, so that no peak is lost."""
    if len(t_s) <= MOST_POINTS:
        return t_s, value
    stretches = MOST_POINTS // 2
    length = len(t_s) // stretches
    cut = stretches * length
    blocks = np.where(np.isfinite(value[:cut]), value[:cut], 0.0).reshape(stretches, length)
    base = np.arange(stretches) * length
    picks = np.sort(np.concatenate((base + blocks.argmin(axis=1), base + blocks.argmax(axis=1))))
    return t_s[picks], value[picks]


def write(path: Path, analysis: Analysis, history: History) -> None:
    """Write the page.  Raises UserError where plotly is missing or the file cannot be written."""
    try:
        import plotly.graph_objects as graphs
        from plotly.offline import get_plotlyjs
    except ModuleNotFoundError:
        raise UserError("the report needs plotly; install it with: pip install 'mavfdi[report]'") from None
    figures = [_figure(graphs, "Timeline", _timeline(graphs, analysis), height=320)]
    if analysis.replay is not None:
        residuals = _residuals(graphs, analysis, history)
        figures.append(_figure(graphs, "Residuals as a share of their thresholds", residuals, log=True))
        figures.append(_figure(graphs, "Asked for and flown", _signals(graphs, analysis, history)))
    figures.append(_figure(graphs, "Messages of the log", _messages(graphs, analysis), height=420, clock=False))
    parts = [figure.to_html(full_html=False, include_plotlyjs=False, config={"responsive": True}) for figure in figures]
    page = (
        "<!doctype html><html lang='en'><head><meta charset='utf-8'>"
        "<meta name='viewport' content='width=device-width,initial-scale=1'>"
        f"<title>{html.escape(_name(analysis))}</title><style>{STYLE}</style><script>{get_plotlyjs()}</script></head><body>"
        + _summary(analysis)
        + "".join(f"<div class='wide'>{part}</div>" for part in parts)
        + _events(analysis)
        + "</body></html>"
    )
    try:
        path.write_text(page, encoding="utf-8")
    except OSError as error:
        raise UserError(f"{path}: cannot write the report: {error.strerror or error}") from None


def _name(analysis: Analysis) -> str:
    log = analysis.content["log"]
    return str(log["path"]) if isinstance(log, dict) else "log"


def _rows(value: Json) -> Sequence[Mapping[str, Json]]:
    return [row for row in value if isinstance(row, dict)] if isinstance(value, list) else []


def _summary(analysis: Analysis) -> str:
    content = analysis.content
    verdict = str(content["verdict"])
    duration = content["duration_s"]
    reader = content["reader"] if isinstance(content["reader"], dict) else {}
    facts = [
        ("airframe", analysis.replay.airframe.name if analysis.replay is not None else "none configured"),
        ("duration", f"{duration:.1f} s" if isinstance(duration, float) else "unknown"),
        ("frames", f"{reader['frames_v1']} MAVLink 1, {reader['frames_v2']} MAVLink 2, {reader['signed']} signed"),
        ("damage", f"{reader['crc_failures']} CRC failures, {reader['resyncs']} resyncs, tail {reader['tail_bytes']} bytes"),
    ]
    for fault in _rows(content["faults"]):
        confidence = fault["confidence"]
        share = f"{confidence:.1%}" if isinstance(confidence, float) else "?"
        facts.append(("fault", f"{fault['id']} ({share}), isolated at {fault['isolated_t']} s"))
    head = f"<h1>{html.escape(_name(analysis))}</h1><p><span class='verdict' style='background:{VERDICT_COLOURS[verdict]}'>"
    head += f"{verdict.replace('_', ' ')}</span></p>"
    return head + _table(facts) + _checks(analysis)


def _table(rows: Sequence[tuple[str, str]]) -> str:
    cells = "".join(f"<tr><th>{html.escape(name)}</th><td>{html.escape(text)}</td></tr>" for name, text in rows)
    return f"<table>{cells}</table>"


def _checks(analysis: Analysis) -> str:
    checks = _rows(analysis.content["checks"])
    if not checks:
        return ""
    order = {"fault": 0, "warning": 1, "ok": 2, "not_available": 3}
    cells = "".join(
        f"<tr><td style='color:{STATUS_COLOURS[str(check['status'])]}'>{str(check['status']).replace('_', ' ')}</td>"
        f"<td>{html.escape(str(check['id']))}</td><td>{html.escape(str(check['text']))}</td></tr>"
        for check in sorted(checks, key=lambda check: order[str(check["status"])])
    )
    return f"<h2>Checks</h2><div class='wide'><table>{cells}</table></div>"


def _events(analysis: Analysis) -> str:
    cells = "".join(
        f"<tr><td>{line['t'] if line['t'] is not None else ''}</td><td>{line['kind']}/{line['name']}</td>"
        f"<td>{html.escape(str(line['text']))}</td></tr>"
        for line in _rows(analysis.content["events"])
    )
    return f"<h2>Events</h2><div class='wide'><table><tr><th>t, s</th><th>event</th><th></th></tr>{cells}</table></div>"


def _figure(
    graphs: Any, title: str, traces: Sequence[Any], *, height: int = 360, log: bool = False, clock: bool = True
) -> Any:
    figure = graphs.Figure(traces)
    figure.update_layout(
        title=title,
        height=height,
        margin={"l": 50, "r": 10, "t": 50, "b": 40},
        legend={"orientation": "h", "y": -0.2},
        template="plotly_white",
    )
    if clock:
        figure.update_xaxes(title="vehicle clock, s")
    if log:
        figure.update_yaxes(type="log")
        figure.add_hline(y=1.0, line_dash="dash")
    return figure


def _timeline(graphs: Any, analysis: Analysis) -> list[Any]:
    """Events as marks in a row a kind; findings of checks that lasted as bands."""
    traces = []
    for kind, colour in EVENT_COLOURS.items():
        lines = [line for line in _rows(analysis.content["events"]) if line["kind"] == kind and line["t"] is not None]
        if lines:
            traces.append(
                graphs.Scatter(
                    x=[line["t"] for line in lines],
                    y=[kind] * len(lines),
                    text=[f"{line['name']}: {line['text']}" for line in lines],
                    mode="markers",
                    marker={"color": colour, "size": 11},
                    name=kind,
                    hoverinfo="x+text",
                )
            )
    for check in _rows(analysis.content["checks"]):
        spans = check.get("spans")
        if check["status"] in ("warning", "fault") and isinstance(spans, list) and spans:
            x: list[Any] = []
            for span in spans:
                x += [*(span if isinstance(span, list) else []), None]
            traces.append(
                graphs.Scatter(
                    x=x,
                    y=[str(check["id"])] * len(x),
                    mode="lines",
                    line={"width": 9, "color": STATUS_COLOURS[str(check["status"])]},
                    name=str(check["id"]),
                    text=str(check["text"]),
                    hoverinfo="x+text",
                )
            )
    return traces


def _lines(graphs: Any, curves: Sequence[Curve]) -> list[Any]:
    traces = []
    for curve in curves:
        t_s, value = thinned(curve.t_s, curve.value)
        known = [float(number) if math.isfinite(number) else None for number in value]
        traces.append(graphs.Scatter(x=t_s, y=known, mode="lines", name=curve.name, line={"width": 1}))
    return traces


def _residuals(graphs: Any, analysis: Analysis, history: History) -> list[Any]:
    if not history.t_s or analysis.replay is None:
        return []
    t_s, shares = np.array(history.t_s), np.array(history.residuals) / history.thresholds
    names = analysis.replay.airframe.detector.residuals
    return _lines(graphs, [Curve(name, t_s, np.maximum(shares[:, place], 1e-3)) for place, name in enumerate(names)])


def _signals(graphs: Any, analysis: Analysis, history: History) -> list[Any]:
    if not history.t_s or analysis.replay is None:
        return []
    t_s, signals = np.array(history.t_s), np.array(history.signals)
    names = analysis.replay.airframe.detector.signals
    return _lines(graphs, [Curve(name, t_s, signals[:, place]) for place, name in enumerate(names)])


def _messages(graphs: Any, analysis: Analysis) -> list[Any]:
    reader = analysis.content["reader"]
    messages = reader["messages"] if isinstance(reader, dict) else {}
    counted = sorted(messages.items(), key=lambda item: int(str(item[1]))) if isinstance(messages, dict) else []
    most = counted[-25:]
    return [graphs.Bar(x=[count for _, count in most], y=[name for name, _ in most], orientation="h", name="messages")]
