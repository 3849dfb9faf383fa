"""Drafts all files of a machine into a folder: answers, profile, envelope, truth and URDF."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from can_dbc.dbc.codec import load
from controller.crane.startup import TPDO1
from host.exit_codes import CommandFailed, ExitCode
from machine.draft.answers import Answers, answers_of
from machine.draft.questions import answers_text
from machine.draft.toml_text import envelope_text, profile_text
from machine.loading.profile_file import ProfileError, load_profile
from runtime.errors import InputRefused
from sim.draft import truth_and_urdf

ENCODER_SENDER: Final = "ENC"
"""The sender of encoder frames in crane.dbc."""


def make(raw: dict[str, Any], where: str, folder: Path) -> Path:
    """Write the files of the machine of these parsed answers; returns the path of the profile.

    The envelope has no seal: a person checks it first.

    Raises:
        CommandFailed: the answers cannot be used, or a file exists.
    """
    try:
        answers = answers_of(raw, where)
    except InputRefused as error:
        raise CommandFailed.from_error(error, ExitCode.CONFIGURATION) from None
    texts = _texts(answers)
    present = [folder / name for name in texts if (folder / name).exists()]
    if present:
        text = f"{present[0]} exists and is not overwritten; choose another folder, or remove the old files"
        raise CommandFailed("machine.file-exists", text, ExitCode.USAGE)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            (folder / name).write_text(text, encoding="utf-8")
    except OSError as error:
        text = f"{folder}: the files cannot be written: {error.strerror}; choose another folder"
        raise CommandFailed("machine.unwritable", text, ExitCode.CONFIGURATION) from None
    return folder / f"{answers.name}.toml"


def _texts(answers: Answers) -> dict[str, str]:
    """Write the text of every file, by its name."""
    drafted = profile_text(answers, encoder_messages())
    with TemporaryDirectory() as scratch:
        path = Path(scratch) / f"{answers.name}.toml"
        path.write_text(drafted, encoding="utf-8")
        try:
            profile = load_profile(path)
        except ProfileError as error:
            text = "\n".join(["these answers make no machine", *map(str, error.problems)])
            raise CommandFailed(error.code, text, ExitCode.CONFIGURATION) from None
    truth, urdf = truth_and_urdf(answers, profile)
    return {
        f"{answers.name}.answers.toml": answers_text(answers),
        f"{answers.name}.toml": drafted,
        f"{answers.name}.envelope.toml": envelope_text(profile),
        f"{answers.name}.truth.toml": truth,
        f"{answers.name}.urdf": urdf,
    }


def encoder_messages() -> dict[int, str]:
    """Return the encoder messages of ``crane.dbc`` by the node that sends them."""
    codecs = load("crane").messages.values()
    return {m.key - TPDO1: m.name for m in codecs if ENCODER_SENDER in m.senders and TPDO1 < m.key < TPDO1 + 0x80}
