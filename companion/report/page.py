"""The HTML around the figures: what happened in a few lines first, details behind it."""

import html
from collections.abc import Mapping, Sequence
from pathlib import PurePath
from typing import Final

from companion.analysis import Analysis
from companion.events import Json

VERDICT_COLOURS: Final = {"healthy": "#2e7d32", "fault": "#c62828", "degraded": "#b26a00", "not_judged": "#666666"}
STATUS_COLOURS: Final = {"ok": "#2e7d32", "warning": "#b26a00", "fault": "#c62828", "not_available": "#777777"}
VERDICT_WORDS: Final = {
    "healthy": "healthy: nothing wrong was found",
    "fault": "fault found",
    "degraded": "degraded: something is not as it should be",
    "not_judged": "not judged: the log lacks what that takes",
}
STYLE: Final = """
*{box-sizing:border-box}
body{font-family:system-ui,sans-serif;margin:0 auto;max-width:70rem;padding:.8rem;color:#222;background:#fff;line-height:1.4}
h1{font-size:1.2rem;margin:.2rem 0;overflow-wrap:anywhere}
h2{font-size:1.05rem;margin:1.6rem 0 .2rem}
.verdict{border-left:.5rem solid;padding:.5rem .8rem;margin:.6rem 0;background:#f6f6f6}
.verdict strong{font-size:1.25rem}
.verdict strong::first-letter{text-transform:uppercase}
.verdict strong{display:block}
.verdict ul{margin:.4rem 0 0;padding-left:1.1rem}
.verdict li{margin:.25rem 0;overflow-wrap:anywhere}
.facts{display:grid;grid-template-columns:repeat(auto-fit,minmax(9rem,1fr));gap:.3rem .8rem;font-size:.9rem}
.facts b{display:block;font-size:.75rem;color:#666;font-weight:600}
table{border-collapse:collapse;width:100%;font-size:.9rem}
td,th{border-bottom:1px solid #ddd;padding:.25rem .5rem .25rem 0;text-align:left;vertical-align:top;overflow-wrap:anywhere}
td:first-child{white-space:nowrap}
summary{cursor:pointer;margin:.5rem 0;font-weight:600}
.figure{overflow:hidden}
"""
# A finger that scrolls must not zoom the figure under it.
TOUCH: Final = (
    "if(matchMedia('(pointer:coarse)').matches)"
    "document.querySelectorAll('.plotly-graph-div').forEach(function(d){Plotly.relayout(d,{dragmode:false})})"
)


def page(analysis: Analysis, figures: Sequence[tuple[str, str]], script: str) -> str:
    """The whole file.  figures: (heading, HTML) each; script: plotly's JavaScript."""
    drawn = "".join(f"<h2>{html.escape(heading)}</h2><div class='figure'>{figure}</div>" for heading, figure in figures)
    return (
        "<!doctype html><html lang='en'><head><meta charset='utf-8'>"
        "<meta name='viewport' content='width=device-width,initial-scale=1'><link rel='icon' href='data:,'>"
        f"<title>{html.escape(_name(analysis))}</title><style>{STYLE}</style><script>{script}</script></head><body>"
        f"{_head(analysis)}{drawn}{_checks(analysis)}{_events(analysis)}<script>{TOUCH}</script></body></html>"
    )


def _name(analysis: Analysis) -> str:
    return PurePath(analysis.path).name


def _rows(value: Json) -> Sequence[Mapping[str, Json]]:
    return [row for row in value if isinstance(row, dict)] if isinstance(value, list) else []


def _head(analysis: Analysis) -> str:
    verdict = str(analysis.content["verdict"])
    lines = "".join(f"<li>{line}</li>" for line in headlines(analysis))
    return (
        f"<h1>{html.escape(_name(analysis))}</h1>"
        f"<div class='verdict' style='border-color:{VERDICT_COLOURS[verdict]}'>"
        f"<strong style='color:{VERDICT_COLOURS[verdict]}'>{VERDICT_WORDS[verdict]}</strong>"
        + (f"<ul>{lines}</ul>" if lines else "")
        + f"</div>{_facts(analysis)}"
    )


def headlines(analysis: Analysis) -> list[str]:
    """What to read in ten seconds, HTML: each fault with when and how sure, what became of it, what the checks found."""
    lines = [_fault(analysis, fault) for fault in _rows(analysis.content["faults"])]
    events = _rows(analysis.content["events"])
    recoveries = [line for line in events if line["kind"] == "recovery" and line["text"]]
    if recoveries:
        last = recoveries[-1]
        lines.append(f"Recovery: {html.escape(str(last['text']))}{_at(last['t'])}.")
    for status in ("fault", "warning"):
        for check in _rows(analysis.content["checks"]):
            if check["status"] == status:
                colour = STATUS_COLOURS[status]
                told = f"<b style='color:{colour}'>{html.escape(str(check['id']))}</b>: {html.escape(str(check['text']))}"
                lines.append(told + _at(check["t"]))
    return lines


def _fault(analysis: Analysis, fault: Mapping[str, Json]) -> str:
    replay = analysis.replay
    faults = replay.airframe.detector.faults if replay is not None else ()
    text = next((known.text for known in faults if known.id == fault["id"]), str(fault["id"]))
    sure = f", {fault['confidence']:.1%} sure" if isinstance(fault["confidence"], float) else ""
    began = f"; thought to have begun{_at(fault['onset_t'])}" if isinstance(fault["onset_t"], float) else ""
    return (
        f"<b style='color:{STATUS_COLOURS['fault']}'>{html.escape(text)}</b> ({html.escape(str(fault['id']))}){sure}:"
        f" detected{_at(fault['detected_t'])}, named{_at(fault['isolated_t'])}{began}."
    )


def _at(t: Json) -> str:
    return f" at {t:.1f} s" if isinstance(t, float) else ""


def _facts(analysis: Analysis) -> str:
    content = analysis.content
    duration = content["duration_s"]
    reader = content["reader"] if isinstance(content["reader"], dict) else {}
    facts = [
        ("airframe", analysis.replay.airframe.name if analysis.replay is not None else "none configured, general checks"),
        ("duration", f"{duration:.1f} s" if isinstance(duration, float) else "unknown"),
        ("frames", f"{reader['frames_v1']} MAVLink 1, {reader['frames_v2']} MAVLink 2, {reader['signed']} signed"),
        ("damage", f"{reader['crc_failures']} CRC failures, {reader['resyncs']} resyncs, tail {reader['tail_bytes']} bytes"),
    ]
    if isinstance(replay := content.get("replay"), dict):
        facts.append(("replay", "decided the same as in flight" if replay["same_settings"] else "decided differently"))
    cells = "".join(f"<div><b>{html.escape(name)}</b>{html.escape(text)}</div>" for name, text in facts)
    return f"<div class='facts'>{cells}</div>"


def _checks(analysis: Analysis) -> str:
    """Those that found something stand at the top of the page already: here are all, folded."""
    order = ("fault", "warning", "ok", "not_available")
    checks = sorted(_rows(analysis.content["checks"]), key=lambda check: order.index(str(check["status"])))
    if not checks:
        return ""
    cells = "".join(
        f"<tr><td style='color:{STATUS_COLOURS[str(check['status'])]}'>{str(check['status']).replace('_', ' ')}</td>"
        f"<td>{html.escape(str(check['id']))}</td><td>{html.escape(str(check['text']))}</td></tr>"
        for check in checks
    )
    counts = [sum(check["status"] == status for check in checks) for status in order]
    told = f"{counts[0]} fault, {counts[1]} warning, {counts[2]} ok, {counts[3]} without the messages they need"
    return f"<h2>Checks</h2><details><summary>{told}</summary><table>{cells}</table></details>"


def _events(analysis: Analysis) -> str:
    events = _rows(analysis.content["events"])
    if not events:
        return ""
    cells = "".join(
        f"<tr><td>{_seconds(line['t'])}</td><td>{line['kind']}/{line['name']}</td>"
        f"<td>{html.escape(str(line['text']))}</td></tr>"
        for line in events
    )
    return f"<h2>Events</h2><table><tr><th>t, s</th><th>event</th><th></th></tr>{cells}</table>"


def _seconds(t: Json) -> str:
    return f"{t:.1f}" if isinstance(t, float) else ""
