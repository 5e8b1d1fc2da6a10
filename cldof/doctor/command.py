"""The command: a table for people, JSON for reports."""

from __future__ import annotations

import sys
import textwrap

from .report import Report, examine, first_words

__all__ = ["doctor"]

_MARKS = {"ok": "ok", "note": "note", "bad": "BAD"}
_WIDTH = 110


def doctor(*, as_json: bool, device: int | None, quiet: bool) -> int:
    """Print what was found; 0 if a picture can be made here, else 1."""
    shows_progress = sys.stderr.isatty() and not quiet

    def progress(what: str) -> None:
        if shows_progress:
            print(f"\r\033[Kcldof doctor: {what} ...", end="", file=sys.stderr, flush=True)

    report = examine(progress, device)
    if shows_progress:
        print("\r\033[K", end="", file=sys.stderr, flush=True)
    print(report.as_json() if as_json else _table(report))
    return 0 if report.can_render else 1


def _table(report: Report) -> str:
    widest = max(len(finding.what) for finding in report.findings)
    lines = []
    for finding in report.findings:
        head = f"{_MARKS[finding.state]:4s}  {finding.what:{widest}s}  "
        text = finding.found if not finding.advice else f"{finding.found}\n-> {finding.advice}"
        room = _WIDTH - len(head)
        wrapped = [part for line in text.splitlines() for part in textwrap.wrap(line, room, break_long_words=False)]
        lines += [head + wrapped[0], *(" " * len(head) + line for line in wrapped[1:])]
    for device in report.devices:
        if device["methods"]:
            lines.append("")
            lines.append(f"device {device['index']}: {device['name']}, against stored images")
            for name, result in device["methods"].items():
                lines.append(f"  {name:12s} {_result(result)}")
    lines.append("")
    lines.append("Pictures can be made here." if report.can_render else "No picture can be made here: see above.")
    return "\n".join(lines)


def _result(result: dict[str, object]) -> str:
    if "db" not in result:
        return f"failed: {first_words(str(result['error']))}"
    return f"{result['db']:6.1f} dB  {result['seconds']:5.1f} s"
