"""Demonstrations: an operator's motions of the crane, segmented from a recording of its bus.

Encoder frames become joint positions over time, smoothed without delay.  A motion begins where a joint begins to move
and ends where all of them rest for a while.  Motions that do not move the pin (corrections, tests of the levers) are
left out. A file of demonstrations is text: a comment, column names, then numbers, motions told apart by their
number.  No clock; equal frames give equal demonstrations.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from can_dbc.dbc.codec import Database
from can_dbc.frame import Frame
from machine.geometry.kinematics import pin_position
from machine.joints import JOINTS, Joint
from machine.profile import Encoder, Profile, joint
from machine.sensing import position_from_counts
from runtime.errors import InputRefused

AXES: Final = (Joint.SLEW, Joint.LIFT, Joint.TILT, Joint.EXT)
"""The joints of a demonstration (paper B: q1 to q4)."""
GRID_S: Final = 0.05
SMOOTHING_SIGMA_S: Final = 0.15
"""Standard deviation of the smoothing: shorter than a hand's motion, longer than its tremor."""
MOVING_SHARE: Final = 0.03
"""A joint moves from this share of its greatest speed on."""
PAUSE_S: Final = 0.7
"""A rest at least this long ends a motion; shorter ones are hesitation within it."""
MIN_PIN_TRAVEL_M: Final = 1.0
MIN_DURATION_S: Final = 1.5
_CSV_HEADER: Final = ("motion", "time_s", "slew_rad", "lift_rad", "tilt_rad", "ext_m")


@dataclass(frozen=True, slots=True)
class JointTrack:
    """Positions (n, 4) of `AXES` [rad, m] at times (n,) [s], on an even grid."""

    time_s: np.ndarray
    position: np.ndarray


def joint_track(profile: Profile, database: Database, frames: Iterable[Frame]) -> JointTrack:
    """Read the joints over time from the encoder frames of a crane bus, unsmoothed, every `GRID_S` from first to last.

    Raises:
        InputRefused: an encoder is missing, or the recording is too short.
    """
    encoders: list[Encoder] = []
    for j in AXES:
        encoder = joint(profile, j).encoder
        if encoder is None:
            raise InputRefused(
                "demonstration.no-encoder", f"the {j.name.lower()} of {profile.name} has no encoder to learn from"
            )
        encoders.append(encoder)
    codecs = {database.messages[e.message].key: (i, e, database.messages[e.message]) for i, e in enumerate(encoders)}
    samples: list[tuple[list[int], list[float]]] = [([], []) for _ in AXES]
    received = [0 for _ in AXES]
    frame_count, ends_ns = 0, (1 << 63, -1 << 63)
    for stamp_ns, key, data in frames:
        frame_count, ends_ns = frame_count + 1, (min(ends_ns[0], stamp_ns), max(ends_ns[1], stamp_ns))
        encoder_entry = codecs.get(key)
        if encoder_entry is None or len(data) != encoder_entry[2].length:
            continue
        i, encoder, codec = encoder_entry
        received[i] += 1
        if samples[i][0] and stamp_ns <= samples[i][0][-1]:
            continue
        samples[i][0].append(stamp_ns)
        counts = int(codec.named(codec.decode(data))["Position"])
        samples[i][1].append(position_from_counts(encoder, counts))
    if frame_count > 1 and ends_ns[0] == ends_ns[1]:
        sentence = f"the recording has no time stamps at its {frame_count} frames; record it with them (candump -L)"
        raise InputRefused("demonstration.no-stamps", sentence)
    for j, e, n, (stamps, _) in zip(AXES, encoders, received, samples, strict=True):
        if n > 1 and len(stamps) < 2:
            sentence = f"the time stamps of the recording do not advance at its {n} frames {e.message}; record it anew"
            raise InputRefused("demonstration.no-stamps", sentence)
        if n < 2:
            raise InputRefused(
                "demonstration.encoder-missing",
                f"the recording holds {n or 'no'} frame{'' if n else 's'} {e.message} of the {j.name.lower()} encoder",
            )
    begin, end = max(h[0][0] for h in samples), min(h[0][-1] for h in samples)
    if end - begin < MIN_DURATION_S * 1e9:
        seconds = max(0, end - begin) * 1e-9
        raise InputRefused("demonstration.too-short", f"the recording holds only {seconds:.1f} s with all encoders")
    time_s = np.arange(int((end - begin) * 1e-9 / GRID_S) + 1) * GRID_S
    columns = [
        np.interp(time_s, (np.array(t) - begin) * 1e-9, _unwrapped(e, v))
        for e, (t, v) in zip(encoders, samples, strict=True)
    ]
    return JointTrack(time_s, np.column_stack(columns))


def _unwrapped(encoder: Encoder, positions: list[float]) -> np.ndarray:
    """Return encoder positions without the jump where a slew passes the end of its encoder's range."""
    if encoder.kind != "rotary":
        return np.array(positions)
    return np.unwrap(positions, period=encoder.total_counts * encoder.unit_per_count)


def smoothed(positions: np.ndarray, sigma_s: float = SMOOTHING_SIGMA_S) -> np.ndarray:
    """Smooth positions (n, m) every `GRID_S`, without tremor, noise and delay; the ends stay."""
    half = int(np.ceil(4.0 * sigma_s / GRID_S))
    kernel = np.exp(-0.5 * (np.arange(-half, half + 1) * GRID_S / sigma_s) ** 2)
    kernel /= kernel.sum()
    padded = np.pad(positions, ((half, half), (0, 0)), mode="edge")
    return np.column_stack([np.convolve(column, kernel, mode="valid") for column in padded.T])


def segment_motions(profile: Profile, whole: JointTrack) -> tuple[JointTrack, ...]:
    """Find the point-to-point motions of a track, smoothed, each from rest to rest and from time 0."""
    if len(whole.time_s) < MIN_DURATION_S / GRID_S:
        return ()
    y = smoothed(whole.position)
    limits = np.array([joint(profile, j).speed_limit for j in AXES])
    moves = np.max(np.abs(np.gradient(y, GRID_S, axis=0)) / limits, axis=1) > MOVING_SHARE
    at = np.flatnonzero(moves)
    if not at.size:
        return ()
    pieces = np.split(at, np.flatnonzero(np.diff(at) > PAUSE_S / GRID_S) + 1)
    spare = int(2.0 * SMOOTHING_SIGMA_S / GRID_S)
    motions = []
    for piece in pieces:
        start_index, end_index = max(0, piece[0] - spare), min(len(y) - 1, piece[-1] + spare)
        motion = y[start_index : end_index + 1]
        ends = [np.array(pin_position(profile.kinematics, q)) for q in (motion[0], motion[-1])]
        if float(np.linalg.norm(ends[1] - ends[0])) >= MIN_PIN_TRAVEL_M:
            motions.append(JointTrack(np.arange(len(motion)) * GRID_S, motion))
    return tuple(motions)


def format_demonstrations(profile_name: str, motions: Sequence[JointTrack], every: int = 2) -> str:
    """Write demonstrations as the text of a file, with every ``every``-th sample."""
    lines = [f"# demonstrations of {profile_name}; joint positions as recorded, smoothed", ",".join(_CSV_HEADER)]
    for number, motion in enumerate(motions, 1):
        keep = sorted({*range(0, len(motion.time_s), every), len(motion.time_s) - 1})
        for t, q in zip(motion.time_s[keep], motion.position[keep], strict=True):
            lines.append(f"{number},{t:.2f}," + ",".join(f"{v:.5f}" for v in q))
    return "\n".join(lines) + "\n"


def read_demonstrations(path: Path) -> tuple[str, tuple[JointTrack, ...]]:
    """Read the name of the machine and the motions of a file.

    Raises:
        InputRefused: the file cannot be read or is no file of demonstrations.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputRefused("demonstration.unreadable", f"{path} cannot be read ({error})") from None
    if len(lines) < 3 or not lines[0].startswith("# demonstrations of ") or lines[1] != ",".join(_CSV_HEADER):
        raise InputRefused(
            "demonstration.wrong-format",
            f"{path} is no file of demonstrations; give a recording or a file written by `learn`",
        )
    name = lines[0].removeprefix("# demonstrations of ").split(";")[0].strip()
    try:
        table = np.array([[float(x) for x in line.split(",")] for line in lines[2:] if line])
        assert table.shape[1] == len(_CSV_HEADER) and np.all(np.isfinite(table))
    except (ValueError, AssertionError, IndexError):
        raise InputRefused(
            "demonstration.malformed-line", f"{path} holds a line that is not {len(_CSV_HEADER)} numbers"
        ) from None
    motions = []
    for number in np.unique(table[:, 0]):
        rows = table[table[:, 0] == number]
        time_s = np.arange(int(np.ceil(rows[-1, 1] / GRID_S - 1e-6)) + 1) * GRID_S
        curve = [np.interp(time_s, rows[:, 1], column) for column in rows[:, 2:].T]
        motions.append(JointTrack(time_s, smoothed(np.column_stack(curve), GRID_S)))
    return name, tuple(motions)


def joint_vectors(motion: JointTrack) -> np.ndarray:
    """Return joint vectors (n, 5) of a motion; the unmeasured rotator at 0."""
    return np.column_stack([motion.position, np.zeros((len(motion.position), len(JOINTS) - len(AXES)))])
