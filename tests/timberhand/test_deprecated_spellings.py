"""Former spellings of commands and options keep working, with one note each on stderr."""

from __future__ import annotations

import pytest

from timberhand.deprecated import RENAMED, current_spelling

TODAY = ["mission", "run", "m.geojson", "--detector", "own", "--manager=own", "--max-stops", "3"]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (["log", "decode", "a.log"], ["recording", "decode", "a.log"]),
        (["sim", "shot", "a.png"], ["sim", "picture", "a.png"]),
        (["train", "judges"], ["train", "scorers"]),
        (["mission", "run", "m.geojson", "--eyes", "ours", "--way=ours", "--patience", "3"], TODAY),
        (["mission", "run", "m", "--eyes=faithful"], ["mission", "run", "m", "--detector=paper-b"]),
        (["mission", "run", "m", "--way", "paper-b"], ["mission", "run", "m", "--manager", "paper-b"]),
        (["demo", "--patience", "9"], ["demo", "--max-stops", "9"]),
    ],
)
def test_an_old_spelling_becomes_todays(old: list[str], new: list[str]) -> None:
    arguments, notes = current_spelling(old)
    assert arguments == new
    assert len(notes) == sum(word.partition("=")[0] in {r.option for r in RENAMED} for word in old) or len(notes) == 1


@pytest.mark.parametrize(
    "arguments",
    [TODAY, ["hil", "vcan", "--", "demo", "--patience", "1"], ["record", "--out", "log"], ["demo", "log"], []],
)
def test_todays_spelling_and_words_of_other_programs_stay(arguments: list[str]) -> None:
    assert current_spelling(arguments) == (arguments, [])
