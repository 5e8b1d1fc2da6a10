"""One HTML page with everything inside: plots, images under a slider, tables that sort. Made from a record alone.

It loads nothing: styles and script are inline, images are data URIs, and a content security policy allows no more than
that. Text from the record reaches the page as JSON (with ``<`` escaped) or HTML-escaped, never as markup.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
from importlib import resources
from pathlib import Path
from typing import Any

from ..files import atomic_write
from .analysis import case_table, columns, summary_table, unit_text
from .plots import accuracy_plot, has_matplotlib
from .record import Record

__all__ = ["page", "save_page"]


def save_page(record: Record, path: str | Path) -> None:
    """Write the page; it appears whole or not at all."""
    with atomic_write(path) as stream:
        stream.write(page(record).encode())


def page(record: Record) -> str:
    """The page as text."""
    files = resources.files(__package__).joinpath("web")
    style = files.joinpath("page.css").read_text(encoding="utf-8")
    script = files.joinpath("page.js").read_text(encoding="utf-8")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")
    policy = f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{digest}'"
    run = record.run
    facts = [
        f"cldof {run.get('cldof')}",
        f"commit {run.get('commit')}" if run.get("commit") else "",
        str(run.get("date") or ""),
        f"{run.get('cpu_cores')} CPU cores, {run.get('system')}",
        f"seed {run.get('seed')}",
        f"{run.get('runs')} runs",
    ]
    return "\n".join(
        [
            "<!doctype html>",
            '<html lang="en"><head><meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{html.escape(policy)}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            "<title>cldof: accuracy versus time</title>",
            f"<style>{style}</style></head><body>",
            "<header><h1>Accuracy versus time</h1>",
            f"<p>{' · '.join(html.escape(fact) for fact in facts if fact)}</p></header><main>",
            _compare(),
            _plots(record),
            _tables(record),
            _notes(record),
            "</main>",
            f'<script type="application/json" id="images">{_json(_images(record))}</script>',
            f"<script>{script}</script>",
            "</body></html>",
            "",
        ]
    )


def _json(value: Any) -> str:
    """JSON that cannot end its script element."""
    text = json.dumps(value, ensure_ascii=True, allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _images(record: Record) -> dict[str, dict[str, str]]:
    """Images by case and name; anything that is not an image of ours is left out."""
    found: dict[str, dict[str, str]] = {case: {} for case in record.cases}
    for key, uri in record.images.items():
        case, _, name = key.rpartition("|")
        if case in found and uri.startswith("data:image/webp;base64,"):
            found[case][name] = uri
    return {case: images for case, images in found.items() if images}


def _compare() -> str:
    return """<section id="compare" hidden><h2>Side by side</h2>
<p class="controls">
<label>Case <select id="case"></select></label>
<label>Left <select id="left"></select></label>
<label>Right <select id="right"></select></label>
<label class="check"><input type="checkbox" id="zoom"> 2x</label>
</p>
<div class="stage" id="stage"><img id="below" alt=""><img id="above" alt=""><span id="line"></span>
<span class="tag" id="tag-left"></span><span class="tag right" id="tag-right"></span></div>
<p><label class="slider">Divider <input type="range" id="split" min="0" max="1000" value="500"
aria-label="Divider between the left and the right image"></label></p>
<p class="hint">Drag over the image, or use the arrow keys on the divider. Error maps show the largest difference of a
channel to the reference without jitter: black 0, white 0.25, by square root.</p></section>"""


def _plots(record: Record) -> str:
    if not has_matplotlib():
        return "<section><h2>Plots</h2><p>matplotlib was not installed when this page was made.</p></section>"
    parts = ["<section><h2>Plots</h2>"]
    for case in record.cases:
        pictures = []
        for judge, what in (("method", "without"), ("picture", "with")):
            uri = base64.b64encode(accuracy_plot(record, case, judge)).decode("ascii")
            text = html.escape(f"PSNR over milliseconds for {case}, reference {what} sub-pixel jitter; numbers below")
            pictures.append(f'<img src="data:image/png;base64,{uri}" alt="{text}" loading="lazy">')
        open_now = " open" if len(parts) == 1 else ""
        inside = f'<div class="plots">{"".join(pictures)}</div>'
        parts.append(f"<details{open_now}><summary>{html.escape(case)}</summary>{inside}</details>")
    return "".join([*parts, "</section>"])


def _tables(record: Record) -> str:
    helps = {column.head: column.help for column in columns()}
    parts = ["<section><h2>Tables</h2><p class='hint'>Click a heading, or press Enter on it, to sort.</p>"]
    for unlit in (False, True):
        heads, cells = summary_table(record, unlit)
        if cells:
            title = "Medians over the scenes" + (", base colours only" if unlit else "")
            parts.append(f"<details open><summary>{title}</summary>{_table(heads, cells, helps)}</details>")
    for case in record.cases:
        heads, cells = case_table(record, case)
        parts.append(f"<details><summary>{html.escape(case)}</summary>{_table(heads, cells, helps)}</details>")
    return "".join([*parts, "</section>"])


def _table(heads: list[str], cells: list[list[str]], helps: dict[str, str]) -> str:
    buttons = [
        f'<button type="button" title="{html.escape(helps.get(name, ""))}">{html.escape(name)}</button>'
        for name in heads
    ]
    head = "".join(f'<th scope="col">{button}</th>' for button in buttons)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in line) + "</tr>" for line in cells)
    return (
        f'<div class="scroll"><table class="sortable"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
    )


def _notes(record: Record) -> str:
    parts = ["<section><h2>Conditions</h2><div class='scroll'><table><thead><tr>"]
    heads = ("reference", "views", "noise floor dB", "seconds")
    parts.append("".join(f'<th scope="col">{head}</th>' for head in heads) + "</tr></thead><tbody>")
    for name, facts in record.references.items():
        floor, seconds = facts.get("noise_floor_db"), facts.get("seconds")
        line = (
            name.replace("|", ", "),
            str(facts.get("views")),
            "-" if floor is None else f"{floor:.1f}",
            "-" if seconds is None else f"{seconds:.1f}",
        )
        parts.append("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in line) + "</tr>")
    parts.append("</tbody></table></div><ul>")
    for name, traits in record.devices.items():
        copies = traits.get("copy_16_mb") or {}
        text = f"{name}: {traits.get('compute_units')} compute units, driver {traits.get('driver_version')}"
        if copies:
            text += f", copy of 16 MB {copies.get('median_ms', 0):.2f} ms"
        parts.append(f"<li>{html.escape(text)}</li>")
    parts.append(f"<li>{html.escape(unit_text(record))}</li>")
    if record.run.get("capture_device"):
        parts.append(f"<li>{html.escape('Capture and accumulation: ' + str(record.run['capture_device']))}</li>")
    versions = ", ".join(f"{name} {version}" for name, version in (record.run.get("versions") or {}).items())
    parts.append(f"<li>{html.escape(versions)}</li></ul>")
    if record.skipped:
        parts.append("<h3>Skipped</h3><ul>")
        for key, why in record.skipped.items():
            parts.append(f"<li>{html.escape(key.replace('|', ', '))}: {html.escape(why)}</li>")
        parts.append("</ul>")
    return "".join([*parts, "</section>"])
