"""Branch coverage of the supervisor and the guard by their own tests: ``python -m tests.branch_coverage [SCOPE]``.

Every branch must be taken.  Exit codes: 0 all of them are, 1 a test fails, 2 a branch is not taken.
"""

from __future__ import annotations

import sys

from coverage import Coverage

from tests.safety_scope import SCOPES


def main(names: list[str]) -> int:
    """Run the tests, print the lines and branches that they leave out; returns the exit code."""
    scopes = [scope for scope in SCOPES if not names or scope.name in names]
    sources = [str(path) for scope in scopes for path in scope.sources().values()]
    measured = Coverage(data_file=None, branch=True, include=sources)
    measured.exclude(r"if __name__ == .__main__.:")
    measured.start()
    import pytest  # after the start: importing the tests runs the modules' own statements

    tests = dict.fromkeys(str(path) for scope in scopes for path in scope.tests())
    code = pytest.main(["-q", "-p", "no:cacheprovider", "-o", "timeout=0", "-m", "not slow", *tests])
    measured.stop()
    share = measured.report(show_missing=True, include=sources)
    if code != 0:
        return 1
    return 0 if share == 100.0 else 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
