"""The report of a computer's real-time fitness as one Markdown file with its data as JSON inside; pure.

It is made to be sent, so it holds nothing private: every text passes `without_private`, which removes names of host and
user and paths that are not the system's own.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any, Final

from experiments.timing.fitness import Judgement, Measured, Verdict, disturbances, judge, overall
from host.doctor.facts import Computer, Facts
from host.doctor.finding import Finding, Severity

REMOVED: Final = "(removed)"
_SYSTEM: Final = r"etc|proc|sys|dev"
_PATH: Final = re.compile(rf"(?<![\w.:/])/(?!(?:{_SYSTEM})\b)\w[^\s'\"`,;)|]*/[^\s'\"`,;)|]*")
_COMMON: Final = frozenset({"root", "localhost", ""})
VERSION: Final = 1


def private_words(*words: str) -> frozenset[str]:
    """Words to remove from a report, for example names of host and user; common ones say nothing and stay."""
    return frozenset(words) - _COMMON


def without_private(value: Any, words: Iterable[str]) -> Any:
    """The same plain value; in every text ``words`` and paths outside the system's own folders are removed."""
    if isinstance(value, str):
        text = _PATH.sub(REMOVED, value)
        for word in sorted(words, key=len, reverse=True):
            text = re.sub(rf"(?<!\w){re.escape(word)}(?!\w)", REMOVED, text)
        return text
    if isinstance(value, Mapping):
        return {str(key): without_private(inner, words) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [without_private(inner, words) for inner in value]
    if isinstance(value, frozenset | set):
        return sorted(value)
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def data_of(
    facts: Facts, computer: Computer, findings: Sequence[Finding], measured: Measured | str, words: Iterable[str]
) -> dict[str, Any]:
    """The data of a report; ``measured`` is a sentence when the measurement failed, ``words`` are removed."""
    if isinstance(measured, str):
        advice = "correct what the sentence and the settings below say, and measure again; else send this report"
        judged: tuple[Judgement, ...] = (Judgement("run", Verdict.UNFIT, measured, advice),)
        more: dict[str, Any] = {"measured": None, "disturbed": []}
    else:
        judged = judge(measured.figures)
        more = {"measured": asdict(measured), "disturbed": disturbances(measured.figures)}
    data = {
        "report": VERSION,
        "verdict": overall(judged).value,
        "judgements": [asdict(j) for j in judged],
        **more,
        "computer": asdict(computer),
        "settings": asdict(facts),
        "findings": [f.document() for f in findings],
    }
    found: dict[str, Any] = without_private(data, words)
    return found


def text_of(data: dict[str, Any]) -> str:
    """The report of these data."""
    lines = ["# Real-time report", "", f"Verdict: **{data['verdict']}**.", ""]
    if data["disturbed"]:
        lines += [f"The computer was disturbed: {'; '.join(data['disturbed'])}.", ""]
    lines += ["| topic | verdict | found | what to do |", "|---|---|---|---|"]
    for j in data["judgements"]:
        lines.append(f"| {j['topic']} | **{j['verdict']}** | {_cell(j['sentence'])} | {_cell(j['advice'])} |")
    lines += ["", "## Computer", "", "| fact | value |", "|---|---|"]
    parts = [data["computer"], data["settings"], data["measured"] or {}, (data["measured"] or {}).get("figures", {})]
    lines += [f"| {name} | {_cell(value)} |" for part in parts for name, value in part.items() if name != "figures"]
    lines += ["", "## Settings to change, the most useful first", ""]
    wanted = [f for f in data["findings"] if f["severity"] != Severity.FINE.name.lower()]
    for f in wanted:
        lines.append(f"- {f['what']}: {f['sentence']}; gain: {f['gain']}")
        lines += [f"  - `{command}`" for command in f["commands"]]
    lines += [] if wanted else ["None."]
    lines += ["", "## Data", "", "```json", json.dumps(data, indent=1), "```", ""]
    return "\n".join(lines)


def read_data(text: str) -> dict[str, Any]:
    """The data inside a report; raises ValueError when there are none."""
    found = re.search(r"^```json\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    if found is None:
        raise ValueError("this is not a real-time report: it holds no JSON")
    data: dict[str, Any] = json.loads(found[1])
    return data


def _cell(value: object) -> str:
    """Lists as words; a line feed or a column's mark would end the cell."""
    text = ", ".join(map(str, value)) if isinstance(value, list | dict) else str(value)
    return text.replace("|", "\\|").replace("\n", " ")
