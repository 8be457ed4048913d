"""The page of a log, opened in a browser as an owner does it: no script fails, no network is asked, all is there."""

import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser

import numpy as np
import pytest

from companion.analysis import analyze
from companion.cli import main
from companion.picture import History
from companion.report import readings
from companion.report.figures import MOST_POINTS, thinned
from tests.system.flights import CROSSED, Flight, parafoil

CHROMIUM = shutil.which("chromium")
FLAGS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
    "--allow-file-access-from-files",
    "--enable-logging=stderr",
    "--v=0",
    "--virtual-time-budget=5000",
]
LIMIT_S = 60.0
TELEPHONE_PX, DESKTOP_PX = 390, 1200
# A window of a browser is no narrower than 500 px: the telephone is a frame in one.
TELEPHONE = """<body style='margin:0'><iframe id=page src=page.html style='width:{width}px;height:2000px;border:0'></iframe>
<script>page.onload = () => {{
  const shown = page.contentDocument, box = shown.scrollingElement
  document.title = [box.scrollWidth, box.clientWidth, shown.querySelectorAll('svg.main-svg').length].join(' ')
}}</script>"""
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="needs chromium (apt-get install chromium) to open the page")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A crossed flight that is mended, and its page."""
    folder = tmp_path_factory.mktemp("report")
    flight = Flight(5, CROSSED, keep_log=True).fly(80.0)
    (folder / "flight.tlog").write_bytes(flight.rehearsal.log)
    assert main(["analyze", str(folder / "flight.tlog"), "--report", str(folder / "page.html")]) == 1
    return folder


@pytest.fixture(scope="module")
def text(folder):
    return (folder / "page.html").read_text(encoding="utf-8")


def opened(path, profile, *words):
    """What the browser prints of a page, and what its scripts complained of."""
    command = [CHROMIUM, *FLAGS, f"--user-data-dir={profile}", *words, path.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, check=True)
    return done.stdout, [line for line in done.stderr.splitlines() if "CONSOLE" in line or "Uncaught" in line]


@needs_chromium
def test_the_page_opens_without_a_script_error_and_shows_verdict_fault_and_figures(folder, tmp_path):
    dom, complaints = opened(folder / "page.html", tmp_path / "profile", "--dump-dom", f"--window-size={DESKTOP_PX},1500")
    assert complaints == []
    assert ">fault found</strong>" in dom
    assert "control lines crossed" in dom
    assert re.search(r"crossed_lines\), 99\.9% sure: detected at \d+\.\d s, named at \d+\.\d s", dom)
    assert "Recovery: repair verified at " in dom
    figures = dom.split("plotly-graph-div")[1:]
    drawn = [figure for figure in figures if re.search(r"<svg[^>]*main-svg", figure)]
    assert len(drawn) >= 4
    for label in (
        "fault: detected",
        "fault: isolated",
        "recovery: verified",
        "armed",
        "heading rate",
        "frames/s",
        "height, m",
    ):
        assert label in dom


@needs_chromium
def test_a_script_error_would_be_seen(tmp_path):
    (tmp_path / "broken.html").write_text("<script>nothing.here()</script>", encoding="utf-8")
    _, complaints = opened(tmp_path / "broken.html", tmp_path / "profile", "--dump-dom")
    assert len(complaints) == 1


@needs_chromium
def test_on_a_telephone_nothing_stands_beyond_the_edge(folder, tmp_path):
    (folder / "telephone.html").write_text(TELEPHONE.format(width=TELEPHONE_PX), encoding="utf-8")
    words = ("--dump-dom", "--window-size=800,2000")
    dom, complaints = opened(folder / "telephone.html", tmp_path / "profile", *words)
    assert complaints == []
    widths = re.search(r"<title>(\d+) (\d+) (\d+)</title>", dom)
    assert widths is not None
    reaches_px, shown_px, figures = map(int, widths.groups())
    assert (reaches_px, shown_px) == (TELEPHONE_PX, TELEPHONE_PX)
    assert figures >= 4


@needs_chromium
@pytest.mark.parametrize("width_px", [DESKTOP_PX, 500])
def test_the_page_can_be_pictured(width_px, folder, tmp_path):
    image = pytest.importorskip("PIL.Image")
    words = (f"--window-size={width_px},1500", f"--screenshot={tmp_path / 'page.png'}")
    opened(folder / "page.html", tmp_path / "profile", *words)
    with image.open(tmp_path / "page.png") as picture:
        assert picture.size == (width_px, 1500)
        lower = np.asarray(picture.convert("L"))[300:]
    assert (lower < 250).mean() > 0.01  # figures have been drawn, not white paper only


class Links(HTMLParser):
    """What a page would load."""

    def __init__(self):
        super().__init__()
        self.found = []

    def handle_starttag(self, tag, attributes):
        self.found += [value for name, value in attributes if name in ("src", "href", "srcset", "data", "action")]


def test_nothing_is_loaded_from_anywhere(text):
    links = Links()
    links.feed(text)
    assert links.found == ["data:,"]  # an empty icon, so that no browser asks for one
    assert "@import" not in text.partition("<script>")[0]
    assert "url(" not in text.partition("<script>")[0]


def test_the_name_of_a_log_is_text_and_no_markup(folder, tmp_path):
    log = tmp_path / "<img src=x onerror=alert(1)>.tlog"
    log.write_bytes((folder / "flight.tlog").read_bytes())
    assert main(["analyze", str(log), "--report", str(tmp_path / "page.html")]) == 1
    assert "<img" not in (tmp_path / "page.html").read_text(encoding="utf-8").partition("<style>")[0]
    head = (tmp_path / "page.html").read_text(encoding="utf-8").partition("</script></head>")[2]
    assert "&lt;img src=x" in head
    assert "<img" not in head


def test_a_log_without_a_configured_airframe_has_its_sensors_and_its_link(folder, tmp_path):
    found = analyze(folder / "flight.tlog", lambda _: None)
    read = readings.read(found)
    assert [panel.title for panel in read.panels] == [
        "height, m",
        "speed, m/s",
        "attitude, deg",
        "battery, V",
        "GPS satellites",
    ]
    assert [curve.name for curve in read.rates] == ["1/1", "1/191"]
    assert read.clock == "vehicle clock"
    assert read.gaps == ()
    roll = read.panels[2].curves[0]
    assert 20.0 < np.nanmax(np.abs(roll.value)) < 90.0  # degrees
    assert len(roll.t_s) == found.content["reader"]["messages"]["ATTITUDE"]
    from companion import report

    report.write(tmp_path / "page.html", found, History())
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "<h2>Sensors</h2>" in page
    assert "<h2>Asked for and flown</h2>" not in page


def test_the_rates_of_the_link_add_up_to_the_frames_of_the_log(folder):
    found = analyze(folder / "flight.tlog", lambda _: parafoil())
    read = readings.read(found)
    counted = sum(float(curve.value.sum()) for curve in read.rates)
    whole = found.content["reader"]["frames_v2"]
    assert whole - 200 < counted <= whole  # but for the last second, which is cut off by the end


def test_a_hole_in_the_log_is_a_gap_of_the_link_and_no_line_in_the_curves(folder, tmp_path):
    from companion.tlog import Reader, record

    records = list(Reader(folder / "flight.tlog"))
    first_us = records[0].stamp_us
    kept = [one for one in records if not 30e6 < one.stamp_us - first_us < 45e6]
    (tmp_path / "hole.tlog").write_bytes(
        b"".join(record(one.stamp_us & ~3, one.stamp_us & 3, one.frame.raw) for one in kept)
    )
    read = readings.read(analyze(tmp_path / "hole.tlog", lambda _: None))
    ((start_s, end_s),) = read.gaps
    assert end_s - start_s == pytest.approx(15.0, abs=0.5)
    roll = read.panels[2].curves[0]
    assert np.isnan(roll.value).sum() == 1


def test_the_readings_are_the_same_without_the_compiled_reader(folder, monkeypatch):
    found = analyze(folder / "flight.tlog", lambda _: parafoil())
    compiled = readings.read(found)
    for name in ("companion.columns", "companion.walk"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.setitem(sys.modules, "numba", None)
    import companion

    monkeypatch.delattr(companion, "columns", raising=False)
    monkeypatch.delattr(companion, "walk", raising=False)
    plain = readings.read(found)
    assert "companion.columns" not in sys.modules
    assert (plain.clock, plain.span, plain.gaps) == (compiled.clock, compiled.span, compiled.gaps)
    for one, other in zip((*plain.rates, *_curves(plain)), (*compiled.rates, *_curves(compiled)), strict=True):
        assert one.name == other.name
        np.testing.assert_array_equal(one.t_s, other.t_s)
        np.testing.assert_array_equal(one.value, other.value)


def _curves(read):
    return [curve for panel in read.panels for curve in panel.curves]


def test_thinning_keeps_peaks_ends_the_order_and_what_is_unknown():
    t_s = np.arange(100_003) / 10.0
    value = np.sin(t_s / 50.0)
    value[77_777] = 9.0
    value[50_000:60_000] = np.nan
    thin_s, thin = thinned(t_s, value)
    assert len(thin_s) <= MOST_POINTS
    assert np.all(np.diff(thin_s) > 0.0)
    assert np.nanmax(thin) == 9.0
    assert np.isnan(thin[(thin_s > 5001.0) & (thin_s < 5999.0)]).all()
    assert thin_s[0] < 6.0
    assert thin_s[-1] > t_s[-1] - 6.0
    short = np.array([3.0, np.nan])
    assert thinned(short, short)[1] is short


def test_a_report_that_cannot_be_written_and_one_without_plotly_are_one_line(folder, tmp_path, capsys, monkeypatch):
    log = str(folder / "flight.tlog")
    assert main(["analyze", log, "--report", str(tmp_path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{tmp_path}: cannot write the report" in line
    for name in [name for name in sys.modules if name.partition(".")[0] == "plotly" or name == "companion.report.figures"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "plotly", None)
    import companion.report

    monkeypatch.delattr(companion.report, "figures")
    assert main(["analyze", log, "--report", str(tmp_path / "page.html")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "pip install 'mavfdi[report]'" in line
    assert not (tmp_path / "page.html").exists()
