"""The planning process: controller reports and log lists in, setpoints out, events as JSON lines.

``python -m autonomy --profile palms_471 --controller 127.0.0.1:47001 --report-port 47002 --scene 127.0.0.1:47003``
loads one log into the bunk; with ``--mission FILE`` and a machine that drives, it executes the mission.
``--planner`` chooses the grasp planner (`autonomy.grasp.planners`).  With
``--memory`` the detector is one that looks ahead (`autonomy.perception`, ``--driving``).
``--tell HOST:PORT`` receives a mission report and the chosen grasp twice a second, and ``--order-port`` accepts
operator commands from this computer only (`can_dbc.messages.mission` and `can_dbc.messages.mission` define them).
``--progress FILE`` stores a checkpoint of the mission; if the file exists already, the mission is resumed from it after
the operator has commanded Auto.
The mode switch of a machine that has one holds, starts and resumes either job (`autonomy.manager.operator_switch`).
``--missions DIR`` waits for a mission to be uploaded instead: the console names a file of that folder, and the planner
takes it while the machine is not armed and stands (`autonomy.process.upload`).

Events on stdout: ``phase``, ``grasp`` (logs, reason and probability), ``paused`` (reason), ``running``, ``refused`` (a
setpoint, with the controller's reason number), ``detector`` (an invalid log list); of a mission ``state``, ``load``
(logs on board), ``order`` (an operator command, and why it is refused), ``upload`` (a mission's file, and why it is
refused), ``mission`` (notes and warnings: what its file holds and the mission does not), ``resumed`` (the counts so
far), ``progress`` (why no checkpoint can be written); ``done``, ``failed`` (reason).
SIGTERM and SIGINT stop crane and machine smoothly.  Exit codes: `autonomy.process.command_line`, and 2 for usage.
"""

from __future__ import annotations

import signal
import sys
import time

from autonomy.missions.model import MissionError
from autonomy.process.command_line import BUSY, CONFIGURATION, FAILED, FINE, INTERRUPTED, SAFETY, arguments, emit
from autonomy.process.job_setup import make_job, uploaded_missions
from autonomy.process.planner_process import PlannerProcess
from machine.loading.profile_file import ProfileError, load_profile, profile_hash
from runtime.errors import ConfigError, InputRefused


def main(argv: list[str] | None = None) -> int:
    """Run one job; return the exit code."""
    options = arguments(sys.argv[1:] if argv is None else argv)
    try:
        profile = load_profile(options.profile)
    except ProfileError as error:
        return _complain(str(error))
    if not 0 < options.lease_ms <= profile.timeouts.lease_max_ms:
        return _complain(f"--lease-ms {options.lease_ms}: {profile.name} allows 1..{profile.timeouts.lease_max_ms}")
    try:
        key = options.key_file.read_bytes().strip() if options.key_file else None
    except OSError as error:
        return _complain(f"{options.key_file}: the key cannot be read: {error.strerror}")
    try:
        job = make_job(options, profile, options.lease_ms * 1_000_000, key)
        uploads = uploaded_missions(options, profile, options.lease_ms * 1_000_000, key)
    except (MissionError, ConfigError, InputRefused) as error:
        if error.code == "checkpoint.finished":
            emit("done", reason=str(error))
            return FINE
        return _complain(str(error))
    try:
        process = PlannerProcess(job, profile_hash(profile), options, key, uploads)
    except (OSError, OverflowError) as error:
        ports = f"{options.report_port}" + (f" or {options.order_port}" if options.order_port is not None else "")
        return _complain(f"UDP port {ports} cannot be opened ({error}); choose another one", BUSY)
    try:
        process.write_checkpoint(time.monotonic_ns())
    except OSError as error:
        process.close()
        return _complain(f"{options.progress}: the checkpoint cannot be written there: {error.strerror}")
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: process.signals.append(number))
    try:
        process.run()
    finally:
        process.close()
    if process.foreign:
        return _complain("the controller runs another profile than this planner; start both with the same one")
    job = process.job
    if job.done:
        emit("done", **job.outcome())
        return FINE
    emit("failed", reason=job.failure, **job.outcome())
    if not process.signals:
        return FAILED
    return SAFETY if process.stopped else INTERRUPTED


def _complain(sentence: str, code: int = CONFIGURATION) -> int:
    sys.stderr.write(f"{sentence}\n")
    return code


if __name__ == "__main__":
    sys.exit(main())
