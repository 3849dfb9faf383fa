"""Carries out the steps of an update, of a rollback, and of what a power cut left.

Before the release in use has changed, a failure leaves everything as it was; after that it changes back.  One at a
time: the folder of the releases is locked (flock(2)).
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Final, Protocol

from host.exit_codes import CommandFailed, ExitCode
from host.release import bundle as bundles
from host.release.gate import Gate, Passage
from host.release.services import Services, refuse_while_armed
from host.release.trees import CURRENT, MARKER, TRIAL, State, Trees

# -- The update as data: its steps in order, and pure decisions about them.
#
# Power may fail before, in or after every step.  Up to `Step.SWITCH` the old release is in use, from then on the
# new one; there is nothing in between, because `Step.SWITCH` is one rename.  From `Step.TRY` to `Step.ACCEPT` the
# disk says where to return to, and the next start of the computer judges the release (`after_interruption`).


class Step(StrEnum):
    """One step; the words are what the command prints."""

    DISARMED = "the machine is disarmed"
    CLEAR = "remove what an interrupted update left"
    UNPACK = "unpack the bundle"
    VERIFY = "check its signature and every file"
    BUILD = "install its packages into a tree of their own"
    SEAL = "mark the tree as whole"
    CHECK = "the new release accepts the settings"
    LINKS = "lay out what is new outside the tree"
    TRY = "note where to return to"
    STOP = "stop the services"
    SWITCH = "change to the other release"
    RELOAD = "let systemd read the units"
    START = "start controller and guard"
    GATE = "wait for READY, STANDBY and GOOD"
    START_OTHERS = "start the other services"
    ACCEPT = "keep it"
    PRUNE = "remove releases before the last two"
    RETURN = "change back"
    END_TRIAL = "end the trial"


_CHANGE: Final = (
    Step.DISARMED,
    Step.TRY,
    Step.STOP,
    Step.SWITCH,
    Step.RELOAD,
    Step.START,
    Step.GATE,
    Step.START_OTHERS,
    Step.ACCEPT,
    Step.PRUNE,
)
_PREPARE: Final = (Step.CHECK, Step.LINKS)
UPDATE: Final = (
    Step.DISARMED,
    Step.CLEAR,
    Step.UNPACK,
    Step.VERIFY,
    Step.BUILD,
    Step.SEAL,
    *_PREPARE,
    *_CHANGE,
)
"""To a bundle's release."""
ROLLBACK: Final = (*_PREPARE, *_CHANGE)
"""To a release that is here already."""
BACK: Final = (Step.STOP, Step.RETURN, Step.RELOAD, Step.END_TRIAL, Step.START, Step.START_OTHERS)
"""Back to the release before, when the new one did not pass."""


def after_interruption(state: State) -> tuple[Step, ...]:
    """List what is left to do after a power cut, from what the links say."""
    if state.trial is None:
        return (Step.CLEAR,)
    if state.trial == state.current:
        return (Step.END_TRIAL, Step.CLEAR)
    return (Step.GATE, Step.START_OTHERS, Step.ACCEPT, Step.PRUNE)


def needs_return(state: State) -> bool:
    """Tell whether a failure now has changed the release in use, so that it must be changed back."""
    return state.trial is not None and state.trial != state.current


# -- Carries out the steps of an update, of a rollback, and of what a power cut left


PLACE: Final = Path("/opt/timberhand")
SIGNER: Final = Path("/etc/timberhand/signer.pem")
"""The public key of those who sign releases for this computer."""
POLL_S: Final = 0.5


class Program(Protocol):
    """What the steps do with a release's own program."""

    def build(self, incoming: Path, tree: Path) -> None:
        """Install a checked bundle into a tree, all but its marker; raises CommandFailed."""

    def check(self, tree: Path) -> None:
        """Check whether the release accepts this computer's settings; raises CommandFailed."""

    def links(self, tree: Path) -> None:
        """Lay out what lies outside the tree; raises CommandFailed."""


class ReleaseProgram:
    """The program of a release: its installation script and its command."""

    def build(self, incoming: Path, tree: Path) -> None:
        """See `Program`."""
        wheel = next((incoming / "wheels").glob("timberhand-*.whl"))
        python = os.path.realpath(sys.executable)
        _run(tree.name, [python, str(wheel / "deploy"), "--tree", "--bundle", str(incoming), "--python", python])

    def check(self, tree: Path) -> None:
        """See `Program`."""
        _run(tree.name, [str(tree / "bin" / "timberhand"), "config", "check"])

    def links(self, tree: Path) -> None:
        """See `Program`."""
        _run(tree.name, ["sh", str(tree / "deploy" / "install.sh"), "--links"])


class Updater:
    """One update at a time; ``report`` gets a line before each step."""

    def __init__(
        self,
        trees: Trees,
        signer: Path,
        services: Services,
        program: Program,
        report: Callable[[str], None],
        gate: Callable[[int], Gate] = Gate,
    ) -> None:
        self._trees, self._signer, self._services, self._program = trees, signer, services, program
        self._report, self._gate = report, gate
        self._bundle = Path()
        self._name = ""

    def update(self, bundle: Path) -> str:
        """Change to a bundle's release; returns its name.

        Raises:
            CommandFailed: it is refused, or it did not pass the gate; the former release is in use.
        """
        self._bundle = bundle
        return self._change(UPDATE)

    def rollback(self) -> str:
        """Change to the previous release; returns its name.  Raises CommandFailed as `update` does."""
        previous = self._trees.state().previous
        if previous is None or previous not in self._trees.whole():
            raise CommandFailed(
                "update.no-previous", "there is no release to go back to; update to the one that you want"
            )
        self._name = previous
        return self._change(ROLLBACK)

    def resume(self) -> str:
        """Finish what a power cut left, at the start of the computer; returns the release in use.

        Raises:
            CommandFailed: the new release did not pass the gate; the former one is in use.
        """
        with self._locked():
            steps = after_interruption(self._trees.state())
            self._name = self._trees.state().current or ""
            self._carry_out(steps)
            return self._trees.state().current or ""

    def _change(self, steps: Sequence[Step]) -> str:
        with self._locked():
            if self._trees.state().trial is not None:
                raise CommandFailed(
                    "update.unfinished", "an update was interrupted; finish it first: timberhand service resume"
                )
            self._carry_out(steps)
            return self._name

    def _carry_out(self, steps: Sequence[Step]) -> None:
        try:
            for step in steps:
                if step in (Step.BUILD, Step.SEAL) and self._name in self._trees.whole():
                    continue
                self._tell(step.value)
                self.do(step)
                if step is Step.VERIFY and self._name == self._trees.state().current:
                    self._trees.prune()
                    self._tell(f"{self._name} is in use already")
                    return
        except BaseException as error:
            # Also Ctrl-C: what began ends in a state that runs.
            if needs_return(self._trees.state()):
                former = self._trees.state().trial
                self._tell("back to the former release")
                for step in BACK:
                    self.do(step)
                if isinstance(error, CommandFailed):
                    raise CommandFailed(error.code, f"{error}; {former} is in use again", error.exit_code) from error
                raise
            self._undo()
            if isinstance(error, OSError):
                raise _of_disk(error) from error
            raise

    def _tell(self, line: str) -> None:
        """Report a line, where that is possible: the terminal may be gone."""
        with contextlib.suppress(OSError):
            self._report(line)

    def _undo(self) -> None:
        """Leave nothing of an update that changed nothing."""
        with contextlib.suppress(OSError):
            if self._trees.state().trial is not None:
                self._trees.end_trial()
                self._services.start()
                self._services.start_others()
            self._trees.clear()

    def do(self, step: Step) -> None:
        """Carry out one step; raises CommandFailed, OSError."""
        trees = self._trees
        match step:
            case Step.DISARMED:
                refuse_while_armed(self._services.mode())
            case Step.CLEAR:
                trees.clear()
            case Step.UNPACK:
                bundles.unpack(self._bundle, trees.incoming)
            case Step.VERIFY:
                self._name = bundles.check_for_here(trees.incoming, self._signer).name
            case Step.BUILD:
                trees.releases.mkdir(parents=True, exist_ok=True)
                self._program.build(trees.incoming, trees.tree(self._name))
            case Step.SEAL:
                trees.seal(self._name, (trees.incoming / MARKER).read_bytes())
            case Step.CHECK:
                self._program.check(trees.tree(self._name))
            case Step.LINKS:
                self._program.links(trees.tree(self._name))
            case Step.TRY:
                trees.point(TRIAL, trees.state().current or "")
            case Step.STOP:
                self._services.stop()
            case Step.SWITCH:
                trees.point(CURRENT, self._name)
            case Step.RETURN:
                trees.point(CURRENT, trees.state().trial or "")
            case Step.RELOAD:
                self._services.reload()
            case Step.START:
                self._services.start()
            case Step.GATE:
                self._wait_at_gate()
            case Step.START_OTHERS:
                self._services.start_others()
            case Step.ACCEPT:
                trees.accept()
            case Step.END_TRIAL:
                trees.end_trial()
            case Step.PRUNE:
                with contextlib.suppress(OSError):  # the next update begins with it
                    trees.prune()

    def _wait_at_gate(self) -> None:
        gate = self._gate(time.monotonic_ns())
        while (passage := gate.step(*self._services.readings(), time.monotonic_ns())) is Passage.WAITING:
            time.sleep(POLL_S)
        if passage is Passage.REFUSED:
            raise CommandFailed(
                "update.gate", f"the release {self._name} did not come up: {gate.lacking}", ExitCode.FIGURE_MISSED
            )

    @contextlib.contextmanager
    def _locked(self) -> Iterator[None]:
        if self._trees.state().current is None:
            raise CommandFailed(
                "update.not-installed", f"there is no installation in {self._trees.place}; see docs/how-to/service.md"
            )
        descriptor = os.open(self._trees.place, os.O_RDONLY | os.O_DIRECTORY)
        try:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise CommandFailed("update.running", "another update is running; wait for its end") from None
            yield
        finally:
            os.close(descriptor)


def _run(name: str, command: Sequence[str]) -> None:
    """Run a release's own program; raises CommandFailed with its last words."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd="/", env=environment)
    if done.returncode:
        lines = (done.stderr.strip() or done.stdout.strip() or "no message").splitlines()
        raise CommandFailed("update.refused", f"the release {name} cannot be used here: {lines[-1]}")


def _of_disk(error: OSError) -> CommandFailed:
    cause = "the disk is full; free some space" if error.errno == errno.ENOSPC else f"{error.strerror}; see dmesg"
    return CommandFailed("update.disk", f"{error.filename or 'a file'} cannot be written: {cause}; nothing has changed")
