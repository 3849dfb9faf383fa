"""The generated pages of docs/reference say what the code says, and the codes of errors keep their form."""

from __future__ import annotations

from runtime.errors import TimberhandError
from timberhand.reference import __main__
from timberhand.reference.__main__ import REPOSITORY


def test_a_code_belongs_to_one_area_of_the_program() -> None:
    """Codes begin with their area; one area is one package, or the program's own commands about it."""
    for code, places in __main__.codes(REPOSITORY).items():
        assert __main__.CODE.fullmatch(code), code
        assert len({taker for taker, _, _ in places}) <= 2, f"{code} is raised as {places}"


def test_an_error_keeps_its_code_across_processes() -> None:
    import pickle

    error = pickle.loads(pickle.dumps(TimberhandError("test.code", "A sentence.")))
    assert (error.code, str(error)) == ("test.code", "A sentence.")
