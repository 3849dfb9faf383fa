"""The acceptance protocol: what it comes to, and what is no protocol."""

from __future__ import annotations

import json
from typing import Any

import pytest

from autonomy.commissioning.acceptance import IDS, Verdict, document, judge, read_protocol
from runtime.errors import InputRefused
from tests.codes import coded


def form(result: str = "pass", **more: Any) -> dict[str, Any]:
    return {"entries": [{"id": i, "result": result} for i in IDS], "machine": "7", "inspector": "Anna"} | more


def judged(told: dict[str, Any]) -> tuple[Verdict, list[str]]:
    return judge(read_protocol(json.dumps(told).encode()))


def test_only_a_whole_passed_and_signed_protocol_is_accepted() -> None:
    assert judged(form()) == (Verdict.ACCEPTED, [])
    for missing in ("machine", "inspector"):
        verdict, reasons = judged(form(**{missing: "  "}))
        assert verdict is Verdict.INCOMPLETE and len(reasons) == 1
    for k in range(len(IDS)):
        told = form()
        told["entries"][k]["result"] = "open"
        assert judged(told)[0] is Verdict.INCOMPLETE
        told["entries"][k]["result"] = "fail"
        verdict, reasons = judged(told)
        assert verdict is Verdict.REFUSED and len(reasons) == 1


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"[]",
        b"\xff",
        b"{}",
        json.dumps(form(verdict="accepted")).encode(),
        json.dumps(form("passed")).encode(),
        json.dumps(form(machine="x" * 81)).encode(),
        json.dumps(form(entries=form()["entries"][1:])).encode(),
        json.dumps(form(entries=form()["entries"] * 2)).encode(),
    ],
)
def test_what_is_no_protocol_is_refused(data: bytes) -> None:
    with pytest.raises(InputRefused):
        read_protocol(data)


def test_missing_checks_have_a_code_and_facts_are_kept() -> None:
    with pytest.raises(InputRefused, check=coded("acceptance.checks")):
        judged(form(entries=[]))
    kept = document(read_protocol(json.dumps(form()).encode()), {"profile": "palms_471"})
    assert kept["profile"] == "palms_471" and kept["verdict"] == "accepted" and kept["inspector"] == "Anna"
