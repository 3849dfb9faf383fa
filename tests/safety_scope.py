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
            "tests/controller/test_load.py",
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
        "test_a_controller_that_goes_on_after_a_stop_is_cut",
        "test_a_joint_may_creep_by_a_twentieth_of_its_speed",
        "test_a_person_gets_from_everywhere_to_armed_once_the_causes_are_gone",
        "test_a_share_of_bad_checksums_breaks_trust",
        "test_every_rule_counts_after_its_time_and_not_before",
        "test_guard_and_valve_node_follow_the_model",
        "test_it_never_enables_again_by_itself",
        "test_loss_of_carrier_or_arms_is_neutral_in_time",
        "test_punctual_commands_pass",
        "test_random_traffic_never_raises_or_enables",
    }
)
"""Tests of many cases or many ticks whose branches quicker ones take as well: measured, they last four times as long.
A branch that only they took would be reported as untested."""

MEASURED = {
    "test_faults.py": (
        "test_bad_value_is_detected_in_time",
        "test_encoder_jump_single_is_refused_and_the_third_stops",
        "test_loss_of_an_optional_input_halves_the_speed",
    ),
    "test_joint_watch.py": (
        "test_a_fault_that_left_the_supply_on_is_raised_by_motion_that_goes_on",
        "test_a_joint_that_does_not_come_to_rest_after_the_end_latches",
        "test_a_person_who_took_over_by_hand_lever_moves_the_machine",
        "test_motion_in_a_stop_that_no_lever_explains_is_cut",
        "test_ten_times_the_noise_halves_the_speed_in_time",
    ),
    "test_load.py": (),
    "test_pressure_monitor.py": (),
    "test_supervisor_link.py": (
        "test_arming_is_refused_while_the_link_is_lost_and_says_what_to_do",
        "test_the_link_is_lost_from_the_limit_on_after_the_stamp_of_the_last_heartbeat",
        "test_what_is_stamped_no_later_than_the_last_changes_nothing",
        "test_a_limit_of_zero_watches_nothing",
    ),
    "test_vehicle_faults.py": (),
}
"""Files whose tests run the whole controller: of them, these take branches that no other measured test takes."""
_TESTS = {path for scope in SCOPES for path in scope.tests()}


def is_measured(path: Path, test: str) -> bool:
    """Whether the branches of a test function count."""
    if path.name in MEASURED:
        return test in MEASURED[path.name]
    return path in _TESTS and test not in UNMEASURED
