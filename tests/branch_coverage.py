"""Branch coverage of the supervisor and the guard by their own tests: ``python -m tests.branch_coverage``.

Every branch must be taken (``[tool.coverage]`` in pyproject.toml has no other threshold).  Exit codes: 0 all of them
are, 1 a test fails, 2 a branch is not taken.
"""

from __future__ import annotations

import sys

from tests.safety_scope import SCOPES


def main() -> int:
    """Run the tests, print the lines and branches that they leave out; returns the exit code."""
    from coverage import Coverage

    sources = [str(path) for scope in SCOPES for path in scope.sources().values()]
    measured = Coverage(data_file=None, branch=True, include=sources)
    measured.start()
    import pytest

    tests = dict.fromkeys(str(path) for scope in SCOPES for path in scope.tests())
    code = pytest.main(["-q", "-p", "no:cacheprovider", "-m", "not slow", *tests])
    measured.stop()
    if code != 0:
        return 1
    measured.exclude(r"if __name__ == .__main__.:")
    share = measured.report(show_missing=True, include=sources)
    return 0 if share == 100.0 else 2


if __name__ == "__main__":
    sys.exit(main())
