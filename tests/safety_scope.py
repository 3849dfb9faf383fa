"""The modules whose tests are themselves tested, and the tests that concern them.

`tests.mutation` and `tests.branch_coverage` read this; both run only these tests, so a change of a rule needs its test
in one of these files.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]


@dataclass(frozen=True, slots=True)
class Scope:
    """A part of the safety layer: its modules and the globs of its test files, the quickest first."""

    name: str
    modules: tuple[str, ...]
    test_globs: tuple[str, ...]

    def sources(self) -> dict[str, Path]:
        """Path of every module, by dotted name."""
        found: dict[str, Path] = {}
        for glob in self.modules:
            for path in sorted(ROOT.glob(glob)):
                name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
                if path.name != "__init__.py":
                    found[name] = path
        return found

    def tests(self) -> list[Path]:
        """The test files."""
        found: list[Path] = []
        for glob in self.test_globs:
            found += [path for path in sorted(ROOT.glob(glob)) if path not in found]
        return found


SCOPES = (
    Scope(
        "supervisor",
        ("controller/supervisor.py", "controller/transitions.py", "controller/operator_link.py"),
        (
            "tests/controller/test_transition_table.py",
            "tests/controller/test_mode_model.py",
            "tests/controller/test_supervisor*.py",
            "tests/controller/test_stalls.py",
            "tests/controller/test_joint_watch.py",
            "tests/controller/test_pressure_monitor.py",
            "tests/controller/test_load_moment.py",
            "tests/controller/test_faults.py",
            "tests/controller/test_vehicle_faults.py",
            "tests/controller/test_bus_faults.py",
        ),
    ),
    Scope(
        "guard",
        ("controller/guard/*.py",),
        ("tests/controller/test_guard*.py",),
    ),
)

UNMEASURED = frozenset(
    {
        "test_a_share_of_bad_checksums_breaks_trust",
        "test_fault_is_detected_in_time_and_the_machine_stops",
        "test_gnss_faults_do_not_stop_articulation_steering",
        "test_it_never_enables_again_by_itself",
        "test_loss_of_carrier_or_arms_is_neutral_in_time",
        "test_loss_of_each_needed_input_is_neutral_in_time",
        "test_machine_that_does_not_drive_is_not_stopped",
        "test_punctual_commands_pass",
        "test_random_traffic_never_raises_or_enables",
    }
)
"""Tests of many cases or many ticks whose branches quicker ones take as well: measured, they last four times as long.
A branch that only they took would be reported as untested."""
