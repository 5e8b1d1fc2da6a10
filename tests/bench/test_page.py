"""The page: made from stored JSON, loads nothing, lets no text become markup, sorts in a real browser."""

from __future__ import annotations

import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import pytest

from cldof.benchmark import command, plots
from cldof.benchmark import page as page_module
from cldof.benchmark.page import page
from cldof.benchmark.record import Record
from tests.bench.records import NASTY, small_record


class Elements(HTMLParser):
    """Collects elements and their attributes."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))


@pytest.fixture(autouse=True)
def _without_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page_module, "has_matplotlib", lambda: False)
    monkeypatch.setattr(plots, "has_matplotlib", lambda: False)


def test_names_never_become_markup() -> None:
    record = small_record(NASTY)
    record.skipped[NASTY] = NASTY
    record.run["system"] = NASTY
    text = page(record)
    assert "<script>alert" not in text
    assert "<img src=x" not in text
    scripts = [attrs for tag, attrs in Elements(text).found if tag == "script"]
    assert len(scripts) == 2  # the data and the program
    assert not any("onerror" in attrs for _, attrs in Elements(text).found)


def test_the_page_loads_nothing() -> None:
    record = small_record()
    record.images["row 8x8|evil"] = "https://example.org/spy.png"
    text = page(record)
    assert "example.org" not in text
    assert not re.search(r"https?://", text)
    policy = next(
        attrs["content"] for _, attrs in Elements(text).found if attrs.get("http-equiv") == "Content-Security-Policy"
    )
    assert policy is not None
    assert policy.startswith("default-src 'none'; img-src data:")


def test_tables_and_slider_can_be_used_by_keyboard() -> None:
    elements = Elements(page(small_record())).found
    assert any(tag == "button" for tag, _ in elements)
    assert any(tag == "input" and attrs.get("type") == "range" and "aria-label" in attrs for tag, attrs in elements)


def test_the_report_is_made_from_stored_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small_record().save(tmp_path / "results.json")
    command.report(Record.load(tmp_path / "results.json"), tmp_path)
    printed = capsys.readouterr().out
    assert "== row 8x8" in printed
    assert "20x" in printed
    assert "vtk is not installed" in printed
    assert "no plots" in printed
    assert (tmp_path / "index.html").read_text() == page(small_record())


def test_plots_of_stored_results(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    record = small_record("costs $5$ <b> 8x8")
    written = plots.save_plots(record, tmp_path)
    assert len(written) == 2
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in written)


def test_sorting_in_a_browser(tmp_path: Path) -> None:
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no Chromium here")
    text = page(small_record())
    # The test's own script is not what the policy allows, so it goes.
    text = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", text)
    probe = """<script>
const table = document.querySelectorAll("table.sortable")[0];
const column = [...table.tHead.rows[0].cells].findIndex((cell) => cell.textContent === "PSNR dB");
const read = () => [...table.tBodies[0].rows].map((row) => row.cells[column].textContent).join(" ");
table.tHead.rows[0].cells[column].querySelector("button").click();
const up = read();
table.tHead.rows[0].cells[column].querySelector("button").click();
document.title = `${up}|${read()}|${document.getElementById("above").naturalWidth >= 0}`;
</script></body>"""
    (tmp_path / "page.html").write_text(text.replace("</body>", probe))
    switches = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run"]
    switches += ["--disable-component-update", "--disable-sync", f"--user-data-dir={tmp_path / 'profile'}"]
    done = subprocess.run(
        [browser, *switches, "--dump-dom", (tmp_path / "page.html").as_uri()],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    title = re.search(r"<title>(.*?)</title>", done.stdout)
    assert title is not None
    assert title.group(1) == "30.00 35.00 40.00 inf|inf 40.00 35.00 30.00|true"
