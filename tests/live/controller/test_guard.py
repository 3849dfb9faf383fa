"""The guard alone, rule by rule, and together with the controller on the bench."""

from pathlib import Path


def test_guard_imports_nothing_but_the_standard_library():
    import subprocess
    import sys

    code = (
        "import sys, controller.guard.__main__; bad = [m for m in sys.modules if m.split('.')[0] in "
        "('can','cantools','canopen','msgspec','numpy','machine') or m in ('can_dbc.dbc.codec','controller.step')]; "
        "print(bad)"
    )
    root = Path(__file__).parents[3]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
