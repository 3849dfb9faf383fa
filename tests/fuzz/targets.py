"""Every target by name."""

from __future__ import annotations

from typing import Final

from tests.fuzz.engine import Target
from tests.fuzz.file_targets import FILES
from tests.fuzz.frame_targets import FRAMES
from tests.fuzz.message_targets import MESSAGES
from tests.fuzz.plc_targets import PLC

TARGETS: Final[dict[str, Target]] = {target.name: target for target in (*FRAMES, *MESSAGES, *PLC, *FILES)}
