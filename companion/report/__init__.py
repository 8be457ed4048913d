"""A log's page: one self-contained HTML file with what happened, when, and how the numbers stood.  Needs the extra `report`.

Drawn from the same analysis that the JSON comes from.  Everything is inside the file, so that it opens without a network,
on a telephone too.  `readings.py` takes the curves out of the log, `figures.py` draws, `page.py` writes the HTML.
"""

from pathlib import Path

from companion.analysis import Analysis
from companion.errors import UserError
from companion.picture import History
from companion.report.page import page
from companion.report.readings import read

__all__ = ["write"]


def write(path: Path, analysis: Analysis, history: History) -> None:
    """Write the page.  Raises UserError where plotly is missing or the file cannot be written."""
    try:
        from companion.report import figures
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] != "plotly":
            raise
        raise UserError("the report needs plotly; install it with: pip install 'mavfdi[report]'") from None
    text = page(analysis, figures.all_of(analysis, history, read(analysis)), figures.script())
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise UserError(f"{path}: cannot write the report: {error.strerror or error}") from None
